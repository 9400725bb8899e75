"""Operator at a terminal: events are printed as lines, answers are typed, any key stops a run."""

import os
import select
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from math import degrees, isnan
from threading import Event
from typing import Final

from equipoise.cli.output import Output
from equipoise.control.ticks import OK, OperatorMessage
from equipoise.printable import printable

STYLES: Final = {
    "fault": "bold red",
    "stopping": "bold yellow",
    "armed": "bold green",
    "balancing": "bold green",
    "notice": "yellow",
    "warning": "yellow",
    "finding good": "green",
    "finding warning": "yellow",
    "finding bad": "bold red",
}


class TerminalOperator:
    """A person at a terminal."""

    def __init__(self, output: Output, stopped: Event | None = None) -> None:
        """Print to an output.

        Args:
            output: The output.
            stopped: Event of a signal, which stops the run in place of a key; nothing is typed.
        """
        self._output, self._stopped = output, stopped
        self._answers: tuple[str, ...] = ()
        self._typed = ""
        self._live = False
        self._ended = False

    def notify(self, event: OperatorMessage) -> None:
        """Print an event."""
        if self._live:
            self._output.stream.write("\r" + " " * 48 + "\r")
            self._live = False
        if event.name != "word":
            self._answers = tuple(event.answers)
            if self._stopped is None:
                _set_keys(single=not self._answers)
        if "\a" in event.text and self._output.stream.isatty():
            self._output.stream.write("\a")
        text = printable(event.text.replace("\a", ""))
        self._output.tell(text, STYLES.get(event.name, "bold" if self._answers else ""))

    def read_input(self) -> list[str]:
        """Return the typed input: whole lines for a question, otherwise any key at once.

        After the end of the input, questions are denied at once, except for a press of the
        pendulum's button, which needs no keyboard.
        """
        if self._stopped is not None:
            return ["stop"] if self._stopped.is_set() else []
        if self._ended:
            denied = bool(self._answers) and OK not in self._answers
            self._answers = () if denied else self._answers
            return ["n"] if denied else []
        came = ""
        while select.select([sys.stdin], [], [], 0.0)[0]:
            try:
                data = os.read(sys.stdin.fileno(), 1024)
            except OSError:  # the terminal was closed
                data = b""
            if not data:
                self._ended = True
                break
            came += data.decode("utf-8", "ignore")
        if not came:
            return []
        if not self._answers and sys.stdin.isatty():
            return [came if came.isprintable() else "a key"]
        *lines, self._typed = (self._typed + came).split("\n")
        return lines

    def live(self, phase: str, phi: float) -> None:
        """Show the angle, on a terminal where no line is typed."""
        if not self._output.stream.isatty() or self._answers:
            return
        angle = "" if isnan(phi) else f"  phi {degrees(phi):+8.2f} deg"
        self._output.stream.write(f"\r  {phase:<12}{angle}   ")
        self._output.stream.flush()
        self._live = True


def _set_keys(*, single: bool) -> None:
    """Let a terminal deliver each key at once, or show and edit a line until Enter."""
    import termios

    with suppress(termios.error, OSError, ValueError):  # no terminal, or closed
        modes, editing = termios.tcgetattr(sys.stdin), termios.ICANON | termios.ECHO
        modes[3] = modes[3] & ~editing if single else modes[3] | editing
        termios.tcsetattr(sys.stdin, termios.TCSANOW, modes)


@contextmanager
def single_keys() -> Generator[None]:
    """Deliver each key at once while the context is open, on a terminal."""
    import termios

    before = termios.tcgetattr(sys.stdin) if sys.stdin.isatty() else None
    _set_keys(single=True)
    try:
        yield
    finally:
        with suppress(termios.error):  # the terminal was closed
            if before is not None:
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
