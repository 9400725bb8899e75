"""Results of checks, and statistics of the durations that they judge."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, Self

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import Value
from equipoise.errors import InputError, OutsideError
from equipoise.rig.interfaces import SETPOINT_PERIOD
from equipoise.safety.rules import MAX_STALL

Array = npt.NDArray[np.float64]
Verdict = Literal["good", "warning", "bad", "unknown"]

STALL: Final = 0.020
"""Delay from which a loop, an encoder or a link counts as stalled [s]: two ticks."""
REPORTED_DURATIONS: Final = (0.001, SETPOINT_PERIOD, STALL, MAX_STALL)
"""Durations beyond which the share is reported [s]: jitter without effect on the controller, one
period of the stream, a stall, and the stall that ends a run."""
HISTOGRAM_EDGES: Final = tuple(digit * 10.0**power for power in range(-5, 0) for digit in (1, 2, 5))
"""Upper ends of a histogram's ranges [s], from 10 us to 0.5 s; the last range is open."""


@dataclass(frozen=True)
class CheckResult:
    """Result of one check."""

    name: str
    """Subject of the check."""
    verdict: Verdict
    """Good; a warning, which goes into the log; bad, which forbids a run; or unknown."""
    found: str
    """The observation, with its numbers."""
    cure: str = ""
    """Action that cures it; empty for a good result."""
    outside: bool = False
    """Whether the rig is at fault, rather than the files and options of the run."""


def rated(
    name: str, verdict: Verdict, found: str, cure: str, *, outside: bool = False
) -> CheckResult:
    """Return the result of a check, without the cure where the verdict is good."""
    return CheckResult(name, verdict, found, "" if verdict == "good" else cure, outside)


def require(results: Sequence[CheckResult]) -> None:
    """Raise an error that names every bad result.

    Raises:
        InputError: Files or options of the run do not fit.
        OutsideError: Every bad result is the rig's fault.
    """
    bad = [result for result in results if result.verdict == "bad"]
    if bad:
        text = "; ".join(f"{result.name}: {result.found}; {result.cure}" for result in bad)
        raise (OutsideError if all(result.outside for result in bad) else InputError)(text)


class Spread(Value):
    """Statistics of a measured duration."""

    n: int
    """Number of measurements."""
    median: float
    """Median [s]."""
    p99: float
    """99th percentile [s]."""
    p99_9: float
    """99.9th percentile [s]."""
    most: float
    """Maximum [s]."""
    longer: dict[str, float]
    """Share of measurements above 1, 5, 20 and 70 ms, keyed by that time in ms."""
    histogram: tuple[tuple[float | None, int], ...]
    """Upper end [s] (None for the open range) and count of each range, from the first to the last
    range that is not empty."""

    @classmethod
    def of(cls, durations: Array) -> Self:
        """Return the statistics of durations [s], shape (n,), n at least 1."""
        median, p99, p99_9 = np.percentile(durations, (50.0, 99.0, 99.9)).tolist()
        counts = np.bincount(
            np.searchsorted(HISTOGRAM_EDGES, durations), minlength=len(HISTOGRAM_EDGES) + 1
        )
        filled = np.flatnonzero(counts)
        ends = (*HISTOGRAM_EDGES, None)
        return cls(
            n=len(durations),
            median=median,
            p99=p99,
            p99_9=p99_9,
            most=float(durations.max()),
            longer={f"{1e3 * t:g}": float((durations > t).mean()) for t in REPORTED_DURATIONS},
            histogram=tuple((ends[k], int(counts[k])) for k in range(filled[0], filled[-1] + 1)),
        )

    def text(self) -> str:
        """Return the statistics as a phrase."""
        times = (self.median, self.p99, self.p99_9, self.most)
        median, p99, p99_9, most = (f"{1e3 * t:.2f}" for t in times)
        return f"median {median} ms, p99 {p99}, p99.9 {p99_9}, at most {most} ({self.n} in all)"
