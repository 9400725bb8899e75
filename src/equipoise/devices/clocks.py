"""Clocks: the machine's own, and one whose time passes only where someone waits."""

import time
from collections.abc import Callable
from typing import Final

TICK: Final = 0.001
"""In so long steps virtual time goes [s]."""


class SystemClock:
    """The machine's monotonic clock, which no change of the date moves."""

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Sleep until a time [s]."""
        while (remaining := moment - time.monotonic()) > 0.0:
            time.sleep(remaining)


class VirtualClock:
    """Time that passes only while someone waits, in whole milliseconds.

    Whatever is attached runs once in each: `work(now)`, in the order of attachment.
    """

    def __init__(self) -> None:
        """Begin at zero, with nothing attached."""
        self._ticks = 0
        self._work: list[Callable[[float], None]] = []

    def attach(self, work: Callable[[float], None]) -> None:
        """Let `work(now)` run in each millisecond from now on."""
        self._work.append(work)

    def now(self) -> float:
        """Return the time [s]."""
        return self._ticks * TICK

    def wait_until(self, moment: float) -> None:
        """Let milliseconds pass until a time [s]."""
        while self.now() < moment - 0.5 * TICK:
            self._ticks += 1
            for work in self._work:
                work(self.now())
