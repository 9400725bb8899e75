"""Lateness of a loop that waits for deadlines, with and without load on the machine."""

import hashlib
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Final

import numpy as np

from equipoise.rig.checks.results import (
    SETPOINT_PERIOD,
    STALL,
    Array,
    CheckResult,
    Spread,
    rated,
)
from equipoise.rig.interfaces import Clock
from equipoise.safety.rules import MAX_STALL

GOOD_LATENESS: Final = 0.001
"""99th percentile of the lateness of a good machine [s]: a fifth of the stream's period, far below
the arm's delay."""
LONG_STALL: Final = 0.040
"""Duration of a stall that is counted apart [s]: a third of the pendulum's time constant."""
HASH_BLOCK: Final = bytes(1 << 20)
"""Block that a loading thread hashes: 0.5 ms and more of work outside the interpreter's lock."""


def lateness(clock: Clock, seconds: float, *, period: float = SETPOINT_PERIOD) -> Array:
    """Measure how late absolute deadlines are met [s], shape (n,).

    A stall over several deadlines makes all of them late, as in a run.

    Args:
        clock: The clock to wait at.
        seconds: Length of the measurement [s]; at least one deadline.
        period: Time between deadlines [s].
    """
    late = np.zeros(max(round(seconds / period), 1))
    begin = clock.now()
    for k in range(len(late)):
        deadline = begin + (k + 1) * period
        clock.wait_until(deadline)
        late[k] = clock.now() - deadline
    return late


@contextmanager
def burning(threads: int) -> Generator[None]:
    """Keep processor cores busy for the duration of a block.

    Args:
        threads: Number of loading threads; each fills a core and rarely holds the interpreter's
            lock.
    """
    over = threading.Event()

    def burn() -> None:
        while not over.is_set():
            hashlib.sha256(HASH_BLOCK).digest()

    burners = [threading.Thread(target=burn, daemon=True) for _ in range(threads)]
    for burner in burners:
        burner.start()
    try:
        yield
    finally:
        over.set()
        for burner in burners:
            burner.join()


def stalls(late: Array) -> tuple[float, ...]:
    """Return the duration of each stall [s]: a stall makes several deadlines late, the first most.

    Args:
        late: Lateness of each deadline, from `lateness` [s], shape (n,).
    """
    stalled = late > STALL
    begins = stalled & ~np.append(False, stalled[:-1])
    return tuple(late[begins].tolist())


def check_lateness(late: Spread) -> CheckResult:
    """Judge how late deadlines are met, stalls apart."""
    cure = (
        "setpoints will come unevenly: end other programs, set the governor, allow real-time "
        "priority; measure again with --seconds 60"
    )
    return rated("deadlines", "warning" if _uneven(late) else "good", late.text(), cure)


def check_stalls(durations: Sequence[float], seconds: float) -> CheckResult:
    """Judge the stalls of a machine: whether a run outlasts them.

    Args:
        durations: Duration of each stall [s].
        seconds: Length of the measurement [s].
    """
    longest = max(durations, default=0.0)
    if not durations:
        return CheckResult("stalls", "good", f"none above {1e3 * STALL:g} ms in {seconds:g} s")
    longer = sum(duration > LONG_STALL for duration in durations)
    found = (
        f"{len(durations)} above {1e3 * STALL:g} ms in {seconds:g} s, {longer} above "
        f"{1e3 * LONG_STALL:g} ms, the longest {1e3 * longest:.0f} ms: "
    )
    cure = (
        "end other programs, then cure the results above (kernel, governor, priority, no virtual "
        "machine); measure again with --seconds 60"
    )
    if longest > MAX_STALL:
        found += f"a run ends at {1e3 * MAX_STALL:g} ms"
        return CheckResult("stalls", "bad", found, cure)
    found += f"a run rides through {1e3 * MAX_STALL:g} ms"
    return CheckResult("stalls", "warning", found, cure)


def check_loaded_lateness(late: Spread) -> CheckResult:
    """Judge how late deadlines are met on a busy machine; never bad, for a run can avoid load."""
    return rated(
        "deadlines under load",
        "warning" if _uneven(late) else "good",
        late.text(),
        "nothing else may run during a run; allow real-time priority, and use a kernel with "
        "PREEMPT_RT",
    )


def _uneven(late: Spread) -> bool:
    """Return whether setpoints would be sent unevenly."""
    return late.p99 > GOOD_LATENESS or late.most > SETPOINT_PERIOD
