"""Clocks of a rig: the machine's, virtual time that passes only in waits, and one that drains.

Virtual time stands still while a driver waits in another way than at its clock; `ended_stalls` ends
such a wait.
"""

import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final

from equipoise.errors import LinkError
from equipoise.rig.host import handled_signals
from equipoise.rig.interfaces import AngleSensor, Clock

TICK: Final = 0.001
"""Period of the functions attached to virtual time [s]."""
ROUNDING: Final = 1e-9
"""Time by which a wait may end before a whole millisecond, and still reach it [s]."""
DEVICE_TIMEOUT: Final = 10.0
"""Real time in which a clock has to advance while a device is called [s]."""


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
            until = min(time, until + 0.010)
            self._clock.wait_until(until)
            with suppress(LinkError):  # not connected yet; or the next reader gets the error again
                self._sensor.samples()


@contextmanager
def ended_stalls(clock: Clock, *devices: object) -> Generator[None]:
    """End calls of devices in which the clock stands still; in the main thread only.

    Compilation takes real time only, and is no stall.

    Args:
        clock: Clock of the rig.
        devices: The devices, the clock among them if it runs a rig.

    Raises:
        LinkError: The clock stalled for `DEVICE_TIMEOUT` real seconds; names call and line.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    seen, watched = clock.now(), {id(device) for device in devices}

    def look(_: int, frame: FrameType | None) -> None:
        nonlocal seen
        before, seen = seen, clock.now()
        stack = [caller for caller, _ in traceback.walk_stack(frame)]
        if seen != before or any(
            "numba" in caller.f_globals.get("__name__", "") for caller in stack
        ):
            return
        for call in reversed(stack):
            if id(device := call.f_locals.get("self")) in watched:
                where, line = stack[0].f_code.co_filename, stack[0].f_lineno
                raise LinkError(
                    f"{type(device).__name__}.{call.f_code.co_name} has waited for "
                    f"{DEVICE_TIMEOUT:g} s, in which virtual time stalled at {seen:.3f} s "
                    f"({where}, line {line}); "
                    "a driver waits with the clock that it receives, never with time.sleep"
                )

    with handled_signals([signal.SIGALRM], look):
        before = signal.setitimer(signal.ITIMER_REAL, DEVICE_TIMEOUT, DEVICE_TIMEOUT)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, *before)
