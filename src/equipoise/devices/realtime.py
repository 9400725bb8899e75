"""What lets a loop of Python keep its deadlines, as far as the machine allows it.

Each measure is taken where it is allowed and named where it is not: a run without it is possible,
later ticks are likely, and the log says which it was.
"""

import ctypes
import gc
import os
import sys
from typing import Final, NamedTuple

PRIORITY: Final = 60
"""Of the loop under SCHED_FIFO: above all ordinary work, below the threads of the kernel's
interrupts that carry its bytes, which have 50 on a kernel for real time only if they are tuned."""
MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2


class RealtimeSetting(NamedTuple):
    """One thing that makes ticks punctual."""

    name: str
    """What it is."""
    taken: bool
    """Whether the machine allowed it."""
    note: str
    """How it is now, or what to do about it."""


def prepare(core: int = -1) -> tuple[RealtimeSetting, ...]:
    """Make this process punctual; call it once all memory is laid out and all code was run.

    Args:
        core: Place of the core to stay on among those that are allowed; the last one if not given.

    Returns:
        What was done, and what was not allowed.
    """
    return freeze_garbage(), lock_memory(), real_time_priority(), stay_on_core(core)


def freeze_garbage() -> RealtimeSetting:
    """Let Python not look for garbage any more: that would stop the loop for milliseconds."""
    gc.collect()
    gc.freeze()
    gc.disable()
    return RealtimeSetting("garbage collection", True, "off")


def lock_memory() -> RealtimeSetting:
    """Keep all memory in RAM."""
    name = "memory locked"
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(MCL_CURRENT | MCL_FUTURE) == 0:
            return RealtimeSetting(name, True, "all pages stay in memory")
        reason = os.strerror(ctypes.get_errno())
    except (AttributeError, OSError, TypeError) as error:
        reason = str(error)
    return RealtimeSetting(
        name,
        False,
        f"{reason}; allow it in /etc/security/limits.conf: @realtime - memlock unlimited",
    )


def real_time_priority(priority: int = PRIORITY) -> RealtimeSetting:
    """Run before all ordinary work."""
    name = "real-time priority"
    if sys.platform != "linux":
        return RealtimeSetting(name, False, f"{sys.platform} has no SCHED_FIFO; use Linux")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return RealtimeSetting(
            name,
            False,
            f"{error.strerror}; allow it in /etc/security/limits.conf: @realtime - rtprio 99",
        )
    return RealtimeSetting(name, True, f"SCHED_FIFO {priority}")


def stay_on_core(core: int = -1) -> RealtimeSetting:
    """Stay on one processor core, so that its caches stay warm.

    Args:
        core: Its place among those that are allowed.
    """
    name = "own core"
    if sys.platform != "linux":
        return RealtimeSetting(name, False, f"{sys.platform} cannot do that; use Linux")
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) < 2:
        return RealtimeSetting(
            name, False, "there is one core only; use a machine with two or more"
        )
    chosen = allowed[core]
    try:
        os.sched_setaffinity(0, {chosen})
    except OSError as error:
        return RealtimeSetting(
            name, False, f"core {chosen}: {error.strerror}; give one of {allowed}"
        )
    return RealtimeSetting(name, True, f"core {chosen}")
