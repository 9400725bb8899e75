"""Output of the verbs: results on stdout, progress and errors on stderr.

With `--json` stdout carries one object and nothing else. Text is never interpreted as markup, and
control characters in text from files and wires are escaped (`equipoise.printable`).
"""

import functools
import json
import math
import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TextIO, TypeVar

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from equipoise.errors import INTERRUPTED, ClosedPipeError, EquipoiseError, InputError, OutsideError
from equipoise.printable import printable

if TYPE_CHECKING:
    from equipoise.artefacts import Estimate
    from equipoise.control.policy import TaskPolicy
    from equipoise.progress import Show, StageProgress
    from equipoise.worlds.evaluation import Done, TrialResults

P = ParamSpec("P")
R = TypeVar("R")

BAD_RESULT = 1
"""Exit code of a finished verb with a bad result."""
VERDICT_STYLES = {"good": "green", "warning": "yellow", "bad": "bold red", "unknown": "dim"}
"""Styles of the verdicts of checks."""
VARIABLES = {
    "SOURCE_DATE_EPOCH": ("[0-9]{1,11}", "whole seconds since 1970"),
    "NUMBA_NUM_THREADS": ("[1-9][0-9]{0,3}", "a number of threads"),
}
"""Form of environment variables on which NumPy, Matplotlib and Numba fail, and its name."""
LEAST_ADDRESS_SPACE = 2**30
"""Minimum limit on the address space for loading the libraries [bytes]; 600 MB are too few."""
QUANTILES = ("0.05", "0.25", "0.75", "0.95")
"""Names of the quantiles of survival in the JSON object."""
command_line: list[str] = []
"""Arguments of the running command, after `equipoise`."""


class _EscapingConsole(Console):
    """A console that escapes all control characters except its own.

    Text as a string is escaped before it is measured and wrapped; all else when it is rendered, and
    may then be longer than its place in a table.
    """

    def on_broken_pipe(self) -> None:
        """End the verb silently."""
        with suppress(SystemExit):
            super().on_broken_pipe()  # discards all further output
        raise ClosedPipeError("the reader of the output has gone")

    def render_str(self, text: str, **kwargs: Any) -> Text:
        """Return a string as rich text."""
        return super().render_str(printable(text, layout=True), **kwargs)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Yield the segments with control characters escaped."""
        for piece in super().render(renderable, options):
            text = piece.text if piece.control else printable(piece.text, layout=True)
            yield Segment(text, piece.style, piece.control)


def _console(*, stderr: bool = False, quiet: bool = False) -> Console:
    return _EscapingConsole(stderr=stderr, quiet=quiet, markup=False, emoji=False, highlight=False)


class Interrupted(KeyboardInterrupt):
    """An interruption after which the work can continue."""

    def __init__(self, *options: str, without: str = "") -> None:
        """Record how to continue.

        Args:
            options: Options to add to the command line.
            without: Option to remove from it.
        """
        kept = [word for word in command_line if word != without]
        super().__init__()
        self.again = shlex.join(["equipoise", *kept, *(o for o in options if o not in kept)])
        """Command that continues the work."""


class Output:
    """Output of one run of a verb."""

    def __init__(self, as_json: bool) -> None:
        """Print text, or one JSON object."""
        self._as_json = as_json
        self._words = _console(quiet=as_json)
        self._progress = _console(stderr=True)
        self._live = False

    @property
    def _voice(self) -> Console:
        """Console for words: while a live display is on the same terminal, that of the display."""
        together = self._live and self._words.is_terminal and not self._as_json
        return self._progress if together else self._words

    def say(self, what: Any = "", *, style: str | None = None) -> None:
        """Print words or a table."""
        self._voice.print(what, style=style)

    def tell(self, what: Any) -> None:
        """Print a message for the operator; with `--json` on stderr."""
        (self._progress if self._as_json else self._voice).print(what)

    @property
    def stream(self) -> TextIO:
        """Stream of the messages for the operator."""
        return sys.stderr if self._as_json else sys.stdout

    def rows(self, rows: Mapping[str, str]) -> None:
        """Print a name and a text on each line, in two columns."""
        from rich.table import Table

        table = Table.grid(padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True, style="dim")
        table.add_column(overflow="fold")
        for name, text in rows.items():
            table.add_row(f"  {printable(name)}", printable(text))
        self.say(table)

    def table(
        self,
        columns: Sequence[str],
        rows: Iterable[Sequence[str]],
        *,
        bold: int | None = None,
        section: int | None = None,
    ) -> None:
        """Print a table: the first column on the left, the others on the right.

        Args:
            columns: Titles; after the first one, a title that ends in `<` is on the left, too.
            rows: Texts of each row.
            bold: Row in bold print.
            section: Row with a line below it.
        """
        from rich.box import SIMPLE
        from rich.table import Table

        table = Table(box=SIMPLE, pad_edge=False)
        for number, title in enumerate(columns):
            left = number == 0 or title.endswith("<")
            table.add_column(
                title.removesuffix("<"),
                justify="left" if left else "right",
                no_wrap=not title.endswith("<"),
            )
        for number, row in enumerate(rows):
            table.add_row(
                *row, style="bold" if number == bold else None, end_section=number == section
            )
        self.say(table)

    def points(self, lines: Iterable[str]) -> None:
        """Print sentences, each with a dash before it and blank lines around them all."""
        from rich.table import Table

        table = Table.grid(padding=(0, 1, 0, 0))
        for line in lines:
            table.add_row("-", printable(line))
        self.say()
        self.say(table)
        self.say()

    def warn(self, *texts: str | None) -> None:
        """Print warnings; None is left out."""
        for what in filter(None, texts):
            self.say(Text.assemble(("warning: ", "bold yellow"), printable(what)))

    def wrote(self, *paths: Path) -> None:
        """Name the files that were written."""
        *first, last = (printable(str(path)) for path in paths)
        names = f"{', '.join(first)} and {last}" if first else last
        self._voice.print(Text.assemble(("wrote ", "dim"), names), soft_wrap=True)

    def next(self, *command: object) -> None:
        """Print the next command to try, without arguments that were not given (None)."""
        words = printable(shlex.join(["equipoise", *(str(w) for w in command if w is not None)]))
        self._voice.print(Text.assemble(("next: ", "dim"), (words, "bold")), soft_wrap=True)

    def result(self, *, bad: bool = False, **fields: Any) -> None:
        """Print the object of `--json`, and nothing without it.

        Args:
            bad: Whether the verb ends with the exit code of a bad result.
            fields: Fields of the object; paths become strings.
        """
        if self._as_json:
            print(json.dumps(fields, allow_nan=False, default=os.fspath))
        if bad:
            raise typer.Exit(BAD_RESULT)

    @contextmanager
    def stages(self) -> "Generator[Show]":
        """Show the stages of the verb on stderr; Ctrl-C or a signal ends them.

        Yields:
            Callback for the progress of each stage, for any thread; it raises where the work shall
            end.
        """
        from equipoise.cli.stages import Stages

        redirect = self._words.is_terminal
        with (
            Stages(self._progress, quiet=self._as_json, redirect=redirect) as stages,
            self._on_the_display(),
            stoppable() as check,
        ):

            def show(progress: "StageProgress") -> None:
                check()
                stages.show(progress)

            yield show

    @contextmanager
    def trials(self, name: str, policy: "TaskPolicy", world: str, total: int) -> "Generator[Done]":
        """Compile kernels, then show the number of finished trials; both are stages.

        Args:
            name: Name of the stage of the trials.
            policy: The policy.
            world: Name of the world.
            total: Number of trials.

        Yields:
            Callback for finished trials.
        """
        from equipoise.progress import compile_trials, compiling, counted

        with self.stages() as show:
            with compiling(show):
                compile_trials(policy, world)
            yield counted(name, total, show)

    @contextmanager
    def busy(self, what: str) -> Generator[Callable[[str], None]]:
        """Show work of unknown duration; yield a function that renames it."""
        from rich.progress import Progress as Bars
        from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

        words = TextColumn("{task.description}", markup=False)
        columns = SpinnerColumn(), words, TimeElapsedColumn()
        console, redirect = self._progress, self._words.is_terminal
        hidden = not console.is_terminal
        bars = Bars(
            *columns, console=console, transient=True, disable=hidden, redirect_stdout=redirect
        )
        with bars as progress, self._on_the_display():
            task = progress.add_task(what, total=None)
            yield lambda now: progress.update(task, description=now)

    @contextmanager
    def _on_the_display(self) -> Generator[None]:
        self._live = self._progress.is_terminal
        try:
            yield
        finally:
            self._live = False


def verb(function: Callable[P, R]) -> Callable[P, R]:
    """Convert errors of Equipoise into one message on stderr and an exit code."""

    @functools.wraps(function)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            _check_environment()
            return function(*args, **kwargs)
        except EquipoiseError as error:
            if not isinstance(error, ClosedPipeError):
                _complain("error: ", str(error))
            raise typer.Exit(error.exit_code) from None
        except MemoryError:
            _complain("error: ", "there is not enough memory; ask for less, or free some")
            raise typer.Exit(OutsideError.exit_code) from None
        except KeyboardInterrupt as stop:
            how = f"; continue with: {stop.again}" if isinstance(stop, Interrupted) else ""
            _complain("", f"interrupted{how}")
            raise typer.Exit(INTERRUPTED) from None

    return guarded


def _check_environment() -> None:
    """Check what the libraries would fail on: environment variables, and the address space.

    Raises:
        InputError: An environment variable is invalid.
        OutsideError: The libraries do not fit into the address space.
    """
    for name, (form, expected) in VARIABLES.items():
        text = os.environ.get(name)
        if text is not None and not re.fullmatch(form, text):
            raise InputError(f"{name} is {text[:40]!r}, expected {expected}; correct or unset it")
    if sys.platform == "win32":
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_SPACE:
        raise OutsideError(
            f"the address space is limited to {limit // 2**20} MiB, expected "
            f"{LEAST_ADDRESS_SPACE // 2**20} MiB or more; raise it with ulimit -v"
        )


def _complain(label: str, message: str) -> None:
    console = _console(stderr=True)
    with suppress(OSError):  # the exit code reports the error, too
        console.print(Text.assemble((label, "bold red"), printable(message)), soft_wrap=True)


@contextmanager
def stoppable() -> Generator[Callable[[], None]]:
    """End work that runs on threads by Ctrl-C or a signal; yield the check for their callbacks.

    The main thread waits for the others, and an interruption reaches it alone.
    """
    from equipoise.rig.signals import SIGNALS, handled_signals

    stopped = threading.Event()

    def stop(*_: object) -> None:
        stopped.set()
        raise KeyboardInterrupt

    def check() -> None:
        if stopped.is_set():
            raise KeyboardInterrupt

    # Ignored signals stay ignored: nohup has its reason.
    heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    with handled_signals(heard, stop):
        yield check


@contextmanager
def stop_by_signal() -> Generator[Callable[[], bool]]:
    """Catch signals that would end the program; yield whether one was received."""
    from equipoise.rig.signals import SIGNALS, handled_signals

    came = threading.Event()
    with handled_signals(SIGNALS, lambda *_: came.set()):
        yield came.is_set


def _format(value: float, half_width: float, size: float) -> str:
    """Return a number with as many digits as its uncertainty leaves meaning (two digits of it).

    At most six digits, and a power of ten where zeros alone would stand before or behind them.

    Args:
        value: The number.
        half_width: Its uncertainty; 0 if unknown.
        size: Size of the numbers that share the form, as the ends of an interval do.

    Example:
        >>> _format(64.07312, 0.0142, 64.0), _format(0.1, 0.0, 0.1), _format(1234.5, 300.0, 1e3)
        ('64.073', '0.1', '1234')
        >>> _format(6.4e-11, 1e-12, 6.4e-11), _format(64.0731234, 1e-9, 64.0)
        ('6.40e-11', '64.0731')
    """
    if not half_width > 0.0 or value == 0.0:
        return f"{value:.4g}"
    leading = math.floor(math.log10(size)) if size > 0.0 else 0
    digits = min(max(leading - math.floor(math.log10(half_width)) + 1, 0), 5)
    if -4 < leading < 6:
        return f"{value:.{max(digits - leading, 0)}f}"
    return f"{value:.{digits}e}"


def measured(estimate: "Estimate", unit: str) -> str:
    """Return an estimate of a quantity that cannot be negative, with 95 % interval and unit."""
    if estimate.value <= 0.0 < estimate.high:
        return f"not distinguishable from 0 {unit}  (95 %: below {estimate.high:.2g})"
    if estimate.high < 0.0:
        return f"{estimate.value:.2g} {unit}, which cannot be: the model does not fit"
    estimate = estimate.not_negative()
    half_width = (estimate.high - estimate.low) / 2.0
    size = abs(estimate.value) or half_width
    value = f"{_format(estimate.value, half_width, size)} {unit}"
    if not half_width > 0.0:
        return f"{value}  ({estimate.source})"
    low, high = (_format(end, half_width, size) for end in estimate.interval)
    return f"{value}  (95 %: {low} to {high})"


def with_intervals(estimates: "Mapping[str, Estimate]") -> dict[str, Any]:
    """Return estimates as fields of `--json`: each value, and its interval beside it."""
    fields: dict[str, Any] = {}
    for name, estimate in estimates.items():
        fields |= {name: estimate.value, f"{name}_interval": list(estimate.interval)}
    return fields


def trial_fields(results: "TrialResults") -> dict[str, Any]:
    """Return the summary of trials as fields of `--json`."""
    fields = results.summary()._asdict()
    quantiles = dict(zip(QUANTILES, fields.pop("quantiles"), strict=True))
    return fields | {"median_s": fields.pop("median"), "quantiles_s": quantiles}


def in_ms(time: "Estimate") -> str:
    """Return an estimate of a time [s] in milliseconds, with its interval."""
    ends = {name: 1e3 * getattr(time, name) for name in ("value", "low", "high")}
    return measured(time.model_copy(update=ends), "ms")


def gauge(share: float, width: int, line: str = " ") -> str:
    """Return a line with a mark at a share: -1 at its left end, 1 at its right end.

    Example:
        >>> gauge(0.5, 9), gauge(-2.0, 5, "-")
        ('    | o  ', 'o-|--')
    """
    middle = width // 2
    places = [line] * width
    places[middle] = "|"
    places[middle + round(max(min(share, 1.0), -1.0) * middle)] = "o"
    return "".join(places)
