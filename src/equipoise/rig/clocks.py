"""Clocks of a rig: the machine's, virtual time that passes only in waits, and one that drains."""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from equipoise.errors import LinkError
from equipoise.rig.interfaces import AngleSensor, Clock

TICK: Final = 0.001
"""Period of the functions attached to virtual time [s]."""
ROUNDING: Final = 1e-9
"""Time by which a wait may end before a whole millisecond, and still reach it [s]."""
DRAIN_PERIOD: Final = 0.010
"""Time between two reads of the encoder while a clock drains it [s]; a terminal buffers 0.1 s of
lines."""


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
    """Virtual time, which passes only during waits.

    Each attached function `work(now)` runs at every whole millisecond, in the order of attachment.
    """

    def __init__(self) -> None:
        """Start at zero, without attached functions."""
        self._ticks, self._now = 0, 0.0
        self._work: list[Callable[[float], None]] = []

    def attach(self, work: Callable[[float], None]) -> None:
        """Run `work(now)` in each millisecond from now on."""
        self._work.append(work)

    def now(self) -> float:
        """Return the time [s]."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Advance to a time [s]."""
        while (tick := (self._ticks + 1) * TICK) <= moment + ROUNDING:
            self._ticks += 1
            self._now = max(tick, self._now)
            for work in self._work:
                work(self._now)
        self._now = max(moment, self._now)


class DrainingClock:
    """Clock for waits before a run; the encoder's samples are dropped meanwhile."""

    def __init__(self, clock: Clock, sensor: AngleSensor) -> None:
        """Wrap a clock, and drain a sensor."""
        self._clock, self._sensor = clock, sensor

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait until a time [s], and drop the samples that come meanwhile."""
        until = self._clock.now()
        while until < time:
            until = min(time, until + DRAIN_PERIOD)
            self._clock.wait_until(until)
            with suppress(LinkError):  # not connected yet; or the next reader gets the error again
                self._sensor.samples()
