"""This computer: signals that end a program, and settings with which a loop keeps its deadlines.

A run is possible without the settings; late ticks are then likelier. The log contains what was
granted.
"""

import ctypes
import gc
import os
import signal
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from typing import Final

SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program: Ctrl-C, a request of the system, a closed terminal."""


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


def prepare(core: int = -1, priority: int = 60) -> dict[str, str]:
    """Apply all settings to this process; call it once all memory is allocated and all code ran.

    Args:
        core: Index of the core to stay on among the allowed ones (default: the last).
        priority: Priority under SCHED_FIFO, by default above the threads of the kernel's
            interrupts, which have 50 on a real-time kernel; 0 for the highest of an ordinary
            process.

    Returns:
        For the name of each setting `granted`, or why this machine refused it.
    """
    gc.collect()
    gc.freeze()
    gc.disable()  # a collection would stop the loop for milliseconds

    granted: dict[str, str] = {}

    @contextmanager
    def setting(name: str) -> Generator[None]:
        try:
            yield
            granted[name] = "granted"
        except (OSError, AttributeError, TypeError) as error:  # denied, or not on this system
            granted[name] = str(error)

    with setting("memory locked"):
        libc = ctypes.CDLL(None, use_errno=True)
        current, future = 1, 2  # MCL_CURRENT, MCL_FUTURE
        if libc.mlockall(current | future):
            raise OSError(os.strerror(ctypes.get_errno()))
    with setting("real-time priority"):
        if priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        else:
            os.setpriority(os.PRIO_PROCESS, 0, -20)
    with setting("own core"):  # whose caches stay warm
        allowed = sorted(os.sched_getaffinity(0))
        if len(allowed) < 2:
            raise OSError("there is one core only")
        os.sched_setaffinity(0, {allowed[core]})
    return granted
