"""Settings of the process with which a loop in Python keeps its deadlines.

The result of each setting states whether the machine granted it. A run is possible without; late
ticks are then likelier. The log contains the results.
"""

import ctypes
import gc
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Final, NamedTuple, TypeVar

T = TypeVar("T")

PRIORITY: Final = 60
"""Priority of the loop under SCHED_FIFO: above all ordinary work. The threads of the kernel's
interrupts, which carry the loop's bytes, have 50 on a real-time kernel unless they are tuned."""
MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2
ALLOW: Final = (
    "sudo groupadd -f realtime; sudo usermod -aG realtime $USER; put `@realtime - rtprio 99` and "
    "`@realtime - memlock unlimited` into /etc/security/limits.conf; log in again"
)
"""Commands that allow real-time priority and locked memory on Linux."""


class RealtimeSetting(NamedTuple):
    """Result of one setting."""

    name: str
    """Subject of the setting."""
    taken: bool
    """Whether the machine allowed it."""
    found: str
    """State of the machine now."""
    cure: str = ""
    """Action that allows the setting; empty where it was taken."""


def prepare(core: int = -1) -> tuple[RealtimeSetting, ...]:
    """Apply all settings to this process; call it once all memory is allocated and all code ran.

    Args:
        core: Index of the core to stay on among the allowed ones (default: the last).

    Returns:
        The result of each setting.
    """
    return freeze_garbage(), lock_memory(), real_time_priority(), stay_on_core(core)


def freeze_garbage() -> RealtimeSetting:
    """Turn off Python's garbage collection, which would stop the loop for milliseconds."""
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
        return RealtimeSetting(name, False, f"not possible here ({error})", "use Linux")
    return _denied(name, reason, "RLIMIT_MEMLOCK", 1024, " KiB")


def real_time_priority(priority: int = PRIORITY) -> RealtimeSetting:
    """Schedule this thread before all ordinary work."""
    name = "real-time priority"
    if sys.platform != "linux":
        return RealtimeSetting(name, False, f"{sys.platform} has no SCHED_FIFO", "use Linux")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return _denied(name, str(error.strerror), "RLIMIT_RTPRIO")
    return RealtimeSetting(name, True, f"SCHED_FIFO {priority}")


def _denied(
    name: str, reason: str, resource_name: str, unit: int = 1, suffix: str = ""
) -> RealtimeSetting:
    """Return the result of a setting that the system's limit forbids."""
    import resource

    limit, _ = resource.getrlimit(getattr(resource, resource_name))
    text = "unlimited" if limit == resource.RLIM_INFINITY else f"{limit // unit}{suffix}"
    found = f"not allowed ({reason}); the limit {resource_name[7:].lower()} is {text}"
    return RealtimeSetting(name, False, found, ALLOW)


def stay_on_core(core: int = -1) -> RealtimeSetting:
    """Pin this thread to one processor core, whose caches stay warm.

    Args:
        core: Index of the core among the allowed ones.
    """
    name = "own core"
    if sys.platform != "linux":
        return RealtimeSetting(name, False, f"{sys.platform} cannot do that", "use Linux")
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) < 2:
        return RealtimeSetting(name, False, "one core only", "use a machine with two or more")
    chosen = allowed[core]
    try:
        os.sched_setaffinity(0, {chosen})
    except OSError as error:
        cure = f"choose one of {allowed}"
        return RealtimeSetting(name, False, f"core {chosen}: {error.strerror}", cure)
    return RealtimeSetting(name, True, f"core {chosen}")


def run_with_realtime_priority(
    work: Callable[[], T], *, take: Callable[[], tuple[RealtimeSetting, ...]] = prepare
) -> tuple[T, tuple[RealtimeSetting, ...]]:
    """Run a function on a thread of its own under the settings of a run, and undo them.

    Priority and core belong to the thread and end with it; garbage collection and the memory lock
    belong to the process and are restored.

    Args:
        work: The function.
        take: Applies the settings.

    Returns:
        Its result, and the result of each setting.
    """
    done: Future[tuple[T, tuple[RealtimeSetting, ...]]] = Future()

    def run() -> None:
        try:
            measures = take()
            done.set_result((work(), measures))
        except BaseException as error:
            done.set_exception(error)

    collects = gc.isenabled()
    try:
        threading.Thread(target=run, daemon=True).start()
        return done.result()
    finally:
        gc.unfreeze()
        if collects:
            gc.enable()
        with suppress(AttributeError, OSError, TypeError):
            ctypes.CDLL(None).munlockall()
