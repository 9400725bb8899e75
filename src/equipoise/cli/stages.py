"""Progress of the stages of a verb: a bar with an expected end, and one line at the end.

The live display is on stderr. Without a terminal, a stage writes one line at its end, and a long
stage also one every 30 s before.
"""

import time
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from threading import Lock
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

if TYPE_CHECKING:
    from equipoise.progress import StageProgress as Reported

LINE_EVERY: Final = 30.0
"""Minimum time between two lines of one stage without a terminal [s]."""
NEARLY: Final = 0.97
"""Maximum share that a bar shows before its stage is done."""
MARGIN: Final = 3
"""Columns at the right that stay free: the `^C` that a terminal echoes there wraps no line."""
NAME: Final = 12
"""Width of a stage's name, in columns."""


class _Stage:
    """Last report of a stage, and its times."""

    def __init__(self, reported: "Reported") -> None:
        self.now, self.first = reported, reported.completed
        self.begin = self.told = time.monotonic()
        self.done = False

    @property
    def took(self) -> float:
        """Time since the beginning [s]."""
        return time.monotonic() - self.begin

    @property
    def share(self) -> float:
        """Displayed share of an unfinished stage [-]."""
        return min(self.now.share, NEARLY)

    @property
    def text(self) -> str:
        """State of the stage, with its count."""
        completed, total, unit = self.now.completed, self.now.total, self.now.unit
        count = f"{completed:,.0f} of {total:,.0f} {unit}" if unit else ""
        return ", ".join(part for part in (count, self.now.text) if part)

    @property
    def line(self) -> str:
        """Line of an unfinished stage, without a terminal."""
        left, more = "", self.now.completed - self.first
        if more > 0.0:
            left = f", about {self.took / more * (self.now.total - self.now.completed):.0f} s left"
        return f"  {self.now.stage:<{NAME}} {100.0 * self.share:7.0f} %  {self.text}{left}"

    @property
    def last_line(self) -> str:
        """Line of a finished stage."""
        what = f"{self.now.total:,.0f} {self.now.unit}" if self.now.unit else self.now.text
        return f"  {self.now.stage:<{NAME}} {self.took:7.1f} s  {what}".rstrip()


class Stages:
    """Display of the unfinished stages of a verb, any number side by side."""

    def __init__(self, console: Console, *, quiet: bool, redirect: bool) -> None:
        """Show them on a console.

        Args:
            console: The console.
            quiet: Write no lines without a terminal.
            redirect: Print text for stdout through this console meanwhile.
        """
        self._console, self._quiet = console, quiet and not console.is_terminal
        self._stages: dict[str, _Stage] = {}
        self._bars = _Bars(self._stages, console, redirect) if console.is_terminal else None
        self._lock = Lock()

    def __enter__(self) -> "Stages":
        """Start the display."""
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bars; the lines stay."""
        if self._bars is not None:
            self._bars.clear()
            self._bars.stop()

    def show(self, reported: "Reported") -> None:
        """Show the progress of a stage; a new one begins, and a complete one ends."""
        with self._lock:
            name = reported.stage
            if name not in self._stages:
                self._stages[name] = _Stage(reported)
                if self._bars is not None:
                    self._bars.add(name)
            stage = self._stages[name]
            if stage.done:
                return
            stage.now = reported
            if stage.now.share >= 1.0:
                stage.done = True
                with self._bars.still() if self._bars is not None else nullcontext():
                    if self._bars is not None:
                        self._bars.drop(name)
                    self._write(stage.last_line)
            elif self._bars is None and time.monotonic() - stage.told >= LINE_EVERY:
                stage.told = time.monotonic()
                self._write(stage.line)

    def _write(self, line: str) -> None:
        if not self._quiet:
            self._console.print(Text(line, style="dim"), soft_wrap=True)


class _Bars(Progress):
    """The live display."""

    def __init__(self, stages: Mapping[str, _Stage], console: Console, redirect: bool) -> None:
        """Draw the stages at each refresh."""
        self._stages, self._rows = stages, dict[str, TaskID]()
        super().__init__(
            TextColumn("  {task.description}", markup=False, table_column=Column(min_width=NAME)),
            BarColumn(bar_width=None, table_column=Column(ratio=1, min_width=8)),
            TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(compact=True),
            TextColumn(
                "{task.fields[text]}",
                markup=False,
                table_column=Column(no_wrap=True, overflow="ellipsis"),
            ),
            console=console,
            transient=True,
            expand=True,
            redirect_stdout=redirect,
        )

    def add(self, name: str) -> None:
        """Add the bar of a stage."""
        self._rows[name] = self.add_task(name, total=1.0, text="")

    def drop(self, name: str) -> None:
        """Remove the bar of a stage."""
        with self._lock:
            self.remove_task(self._rows.pop(name))

    def still(self) -> AbstractContextManager[Any]:
        """Return a context without refreshes.

        Rich computes the cursor's place before it draws; a refresh by its thread in between, with
        another number of bars, would overwrite a line.
        """
        return self.live._lock

    def clear(self) -> None:
        """Remove all bars: an interruption leaves some."""
        for name in list(self._rows):
            self.drop(name)
        self.refresh()

    def get_renderables(self) -> Iterable[RenderableType]:
        """Yield the bars."""
        with self._lock:
            for name, row in self._rows.items():
                stage = self._stages[name]
                self.update(row, completed=stage.share, text=stage.text)
            yield from (Padding(drawn, (0, MARGIN, 0, 0)) for drawn in super().get_renderables())
