"""Output of the verbs: results on stdout, progress and errors on stderr.

With `--json` stdout carries one object and nothing else. Text is never interpreted as markup, and
control characters in text from files and wires are escaped (`equipoise.printable`).
"""

import re
import signal
import sys
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Any, TextIO

import typer
from pydantic_core import to_json
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from equipoise.printable import as_text, label, printable

if TYPE_CHECKING:
    from pydantic import BaseModel

    from equipoise.executors import Show


def _console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """Return a console on stdout or stderr, whose text is no markup; a quiet one prints nothing."""
    return Console(stderr=stderr, quiet=quiet, markup=False, emoji=False, highlight=False)


class Output:
    """Output of one run of a verb."""

    def __init__(self, as_json: bool) -> None:
        """Print text, or one JSON object."""
        self._as_json = as_json
        self._words = _console(quiet=as_json)
        self._messages = _console(stderr=True)
        self.stopped = threading.Event()
        """Whether a signal has ended the verb; `verb` replaces it."""
        self.reserved_names = ExitStack()
        """Names of the files that the verb writes, reserved until its end."""

    def tell(self, what: str, style: str = "") -> None:
        """Print a message for the operator; with `--json` on stderr."""
        text = Text(printable(what, layout=True), style)
        (self._messages if self._as_json else self._words).print(text)

    @property
    def stream(self) -> TextIO:
        """Stream of the messages for the operator."""
        return sys.stderr if self._as_json else sys.stdout

    def warn(self, *texts: str | None) -> None:
        """Print warnings; None and empty texts are left out."""
        for what in filter(None, texts):
            self._words.print(Text.assemble(("warning: ", "bold yellow"), printable(what)))

    def result(
        self, value: "BaseModel | None" = None, *, code: int = 0, then: str = "", **fields: Any
    ) -> None:
        """Print the result of a verb: value and fields as lines and tables, or as a JSON object.

        Args:
            value: Value with a docstring under each field, whose unit is shown. The text has the
                fields of the values in it as well, and leaves out those with `repr=False`.
            code: Exit code of the verb; 1 for a bad result.
            then: Next command to try, after `equipoise`.
            fields: Further fields by name, which ends in the unit; a mapping of mappings is a
                table, and `warnings` are printed as such. The text leaves out None and empty ones.
        """
        if self._as_json:
            dumped = value.model_dump() if value else {}
            text = to_json(dumped | fields, inf_nan_mode="null", fallback=str)
            print(text.decode(), flush=True)
        else:
            shown = _labelled(value) if value else {}
            self.warn(*(fields.pop("warnings", None) or ()), *shown.pop("warnings", ()))
            shown |= {label(name): value for name, value in fields.items()}
            self._words.print(*_tables(shown), sep="\n")
            if then:
                line = Text.assemble(("next: ", "dim"), f"equipoise {printable(then)}")
                self._words.print(line, soft_wrap=True)
        if code:
            raise typer.Exit(code)

    @contextmanager
    def progress(self) -> "Generator[Show]":
        """Show the stages of the verb on stderr; Ctrl-C or a signal ends them.

        Compilation is a stage of its own; machine code in the cache loads within seconds.

        Yields:
            Callback for the progress of each stage, for any thread; it raises where the work shall
            end.
        """
        from rich import progress

        from equipoise.jit import watching_compilation

        bars = progress.Progress(
            progress.TextColumn("  {task.description:<12}", markup=False),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TimeRemainingColumn(elapsed_when_finished=True),
            progress.TextColumn("{task.fields[text]}", markup=False),
            console=self._messages,
            disable=self._as_json and not self._messages.is_terminal,
            redirect_stdout=self._words.is_terminal,
        )
        stages: dict[str, progress.TaskID] = {}
        lock = threading.Lock()

        def update(stage: str, fraction: float | None, text: str) -> None:
            with lock:
                if stage not in stages:
                    stages[stage] = bars.add_task(stage, text="", total=None)
                total = None if fraction is None else 1.0
                bars.update(stages[stage], text=text, total=total, completed=fraction or 0.0)

        with bars, watching_compilation(lambda _: update("compile", None, "")):

            def show(stage: str, fraction: float | None = None, text: str = "") -> None:
                if self.stopped.is_set():
                    raise KeyboardInterrupt
                update(stage, fraction, text)

            yield show
            if "compile" in stages:
                update("compile", 1.0, "")

    @contextmanager
    def busy(self, what: str) -> Generator[Callable[[str], None]]:
        """Show work of unknown duration; yield a function that renames it."""
        with self._messages.status(Text(printable(what))) as status:
            yield lambda now: status.update(Text(printable(now)))


def complain(message: str, label: str = "") -> None:
    """Print an error on stderr."""
    with suppress(OSError):  # the exit code reports the error, too
        text = Text.assemble((label, "bold red"), printable(message))
        _console(stderr=True).print(text, soft_wrap=True)


@contextmanager
def signals(*, raising: bool = False) -> Generator[threading.Event]:
    """Set the yielded event at Ctrl-C or another signal that would end the program.

    Args:
        raising: Whether the main thread is interrupted as well; others look at the event.
    """
    from equipoise.rig.host import SIGNALS, handled_signals

    stopped = threading.Event()

    def stop(*_: object) -> None:
        stopped.set()
        if raising:
            raise KeyboardInterrupt

    # Ignored signals stay ignored: nohup has its reason.
    heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    with handled_signals(heard, stop):
        yield stopped


def _labelled(value: "BaseModel") -> dict[str, Any]:
    """Return the fields of a value, and of the values in it, by name and unit."""
    fields: dict[str, Any] = {}
    for name, info in type(value).model_fields.items():
        unit = re.search(r"\[[^\]]+\]", info.description or "")
        item = getattr(value, name)
        nested = hasattr(item, "model_dump") and not hasattr(item, "interval")
        if nested and info.repr:
            fields |= _labelled(item)
        elif info.repr:
            fields[f"{name} {unit[0]}" if unit else name] = item
    return fields


def _tables(fields: Mapping[str, Any]) -> list[RenderableType]:
    """Return fields as lines of names and values, followed by a table for each nested mapping."""
    lines = Table.grid(padding=(0, 2, 0, 0))
    lines.add_column(no_wrap=True, style="dim")
    lines.add_column(overflow="fold")
    tables: list[RenderableType] = []
    for name, value in fields.items():
        rows: Any = list(value.values()) if isinstance(value, Mapping) else []
        if rows and all(isinstance(row, Mapping) for row in rows):
            table = Table(box=None, padding=(0, 2, 0, 0))
            for title in (name, *map(label, rows[0])):
                table.add_column(printable(title), overflow="fold")
            for title, row in zip(value, rows, strict=True):
                table.add_row(printable(label(title)), *map(as_text, row.values()))
            tables.append(table)
        elif text := as_text(value):
            lines.add_row(f"  {printable(name)}", text)
    return [lines, *tables]
