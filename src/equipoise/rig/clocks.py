"""Clocks: the machine's monotonic clock, and virtual time that passes only in waits."""

import time
from collections.abc import Callable
from typing import Final

TICK: Final = 0.001
"""Step of virtual time [s]."""


class SystemClock:
    """Monotonic clock of the machine, independent of changes of the date."""

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Sleep until a time [s]."""
        while (remaining := moment - time.monotonic()) > 0.0:
            time.sleep(remaining)


class VirtualClock:
    """Virtual time, which passes only during waits, in whole milliseconds.

    Each attached function `work(now)` runs once per millisecond, in the order of attachment.
    """

    def __init__(self) -> None:
        """Start at zero, without attached functions."""
        self._ticks = 0
        self._work: list[Callable[[float], None]] = []

    def attach(self, work: Callable[[float], None]) -> None:
        """Run `work(now)` in each millisecond from now on."""
        self._work.append(work)

    def now(self) -> float:
        """Return the time [s]."""
        return self._ticks * TICK

    def wait_until(self, moment: float) -> None:
        """Advance in milliseconds to a time [s]."""
        while self.now() < moment - 0.5 * TICK:
            self._ticks += 1
            for work in self._work:
                work(self.now())
