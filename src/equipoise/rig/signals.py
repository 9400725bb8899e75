"""Signals that end a program, processes that must not be ended by them, and waits without end."""

import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Final

from equipoise.errors import LinkError
from equipoise.rig.interfaces import Clock

SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program: Ctrl-C, a request of the system, a closed terminal."""
STALL: Final = 10.0
"""Real time in which a clock has to advance while a device is called [s]."""


@contextmanager
def handled_signals(
    signals: Iterable[signal.Signals], handler: Callable[..., object]
) -> Generator[None]:
    """Handle signals in this context; for the main thread only."""
    before = [(number, signal.signal(number, handler)) for number in signals]
    try:
        yield
    finally:
        for number, old in before:
            signal.signal(number, old)


def start_process(process: BaseProcess) -> None:
    """Start a process with signals blocked, until it is ready for them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def ended_stalls(clock: Clock, *devices: object) -> Generator[None]:
    """End calls of devices in which the clock stands still; in the main thread only.

    Virtual time stands still while a driver waits in another way than at its clock. Compilation
    takes real time only, and is no stall.

    Args:
        clock: Clock of the rig.
        devices: The devices, the clock among them if it runs a rig.

    Raises:
        LinkError: The clock stood still for `STALL` real seconds; names call and line.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    seen, calls = clock.now(), {id(device) for device in devices}

    def look(_: int, frame: FrameType | None) -> None:
        nonlocal seen
        before, seen = seen, clock.now()
        stack = [one for one, _ in traceback.walk_stack(frame)]
        if seen != before or any("numba" in one.f_globals.get("__name__", "") for one in stack):
            return
        for call in reversed(stack):
            if id(caller := call.f_locals.get("self")) in calls:
                where, line = stack[0].f_code.co_filename, stack[0].f_lineno
                raise LinkError(
                    f"{type(caller).__name__}.{call.f_code.co_name} has waited for {STALL:g} s, "
                    f"in which virtual time stood still at {seen:.3f} s ({where}, line {line}); "
                    "a driver waits with the clock that it receives, never with time.sleep"
                )

    with handled_signals([signal.SIGALRM], look):
        before = signal.setitimer(signal.ITIMER_REAL, STALL, STALL)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, *before)
