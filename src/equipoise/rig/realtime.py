"""Settings of the process with which a loop in Python keeps its deadlines.

Each setting returns a finding: whether the machine granted it. A run is possible without; late
ticks are then likelier. The log contains the findings.
"""

import ctypes
import gc
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Final, TypeVar

from equipoise.rig.findings import Finding, find

T = TypeVar("T")

PRIORITY: Final = 60
"""Priority of the loop under SCHED_FIFO: above all ordinary work. The threads of the kernel's
interrupts, which carry the loop's bytes, have 50 on a real-time kernel unless they are tuned."""
MCL_CURRENT, MCL_FUTURE = 1, 2
REMEDY: Final = (
    "on Linux: sudo groupadd -f realtime; sudo usermod -aG realtime $USER; put `@realtime - rtprio "
    "99` and `@realtime - memlock unlimited` into /etc/security/limits.conf; log in again"
)
"""Commands that allow real-time priority and locked memory."""


def prepare(core: int = -1) -> list[Finding]:
    """Apply all settings to this process; call it once all memory is allocated and all code ran.

    Args:
        core: Index of the core to stay on among the allowed ones (default: the last).
    """
    gc.collect()
    gc.freeze()
    gc.disable()  # a collection would stop the loop for milliseconds
    settings = (
        ("memory locked", _lock_memory),
        ("real-time priority", _real_time_priority),
        ("own core", lambda: _stay_on_core(core)),
    )
    findings: list[Finding] = []
    for name, apply in settings:
        try:
            apply()
            state = "yes"
        except (OSError, AttributeError, TypeError) as error:  # denied, or not on this system
            state = str(error)
        findings.append(find(name, {"granted": state}, REMEDY, warning=state != "yes"))
    return findings


def _lock_memory() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE):
        raise OSError(os.strerror(ctypes.get_errno()))


def _real_time_priority() -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def _stay_on_core(core: int) -> None:
    """Pin this thread to one core, whose caches stay warm."""
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) < 2:
        raise OSError("there is one core only")
    os.sched_setaffinity(0, {allowed[core]})


def run_with_realtime_priority(work: Callable[[], T]) -> tuple[T, list[Finding]]:
    """Run a function on a thread of its own under the settings of a run, and undo them.

    Priority and core belong to the thread and end with it; garbage collection and the memory lock
    belong to the process and are restored.

    Returns:
        The function's result, and the finding of each setting.
    """
    done: Future[tuple[T, list[Finding]]] = Future()

    def run() -> None:
        try:
            findings = prepare()
            done.set_result((work(), findings))
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
