"""`equipoise log explain`: explains why a run ended."""

from collections.abc import Iterator
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equipoise.cli.output import Output
from equipoise.cli.verb import verb

if TYPE_CHECKING:
    from equipoise.logs.run_log import RunLog

ROWS = 12
"""Number of rows of the table of the end."""
SHOWN = 1.1
"""Duration of the table of the end [s]."""


@verb
def explain(output: Output, run: Path) -> None:
    """Explain why a run ended: causes with their evidence, the most likely first.

    Examines release, pushes, the encoder and its zero, lateness, commands and
    safety rules, and gives advice. A truncated log is read as far as it is
    readable.
    """
    from equipoise.logs.run_log import RunLog
    from equipoise.outcomes import describe
    from equipoise.rig.explanation import explain as why

    read = RunLog.load(run, damaged=True)
    found = why(read)
    log, first = found.log, found.causes[0]
    output.result(
        warnings=[read.damage],
        outcome=found.end.outcome,
        reason=describe(found.end),
        phase=None if read.conditions.simulated else read.last_phase and read.last_phase.value,
        whole=read.end is not None,
        lasted_s=None if log is None else log.lasted,
        cause=first.cause,
        advice=first.advice,
        causes={
            str(one.cause): {"score": one.score, "time_s": one.time, "evidence": one.evidence}
            for one in found.causes
        },
        end=dict(_end(log)) if log is not None and len(log.time) > 1 else None,
        then="log show RUN",
    )


def _end(log: "RunLog") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the state at some times of the last second, by time."""
    last = len(log.time) - 1
    step = max(round(min(SHOWN, log.lasted) / log.conditions.h / (ROWS - 1)), 1)
    for i in sorted({max(last - step * back, 0) for back in range(ROWS)}):
        yield (
            f"{log.time[i]:.2f} s",
            {
                "phi_deg": degrees(log.estimated_phi[i]),
                "x_m": float(log.x[i]),
                "u": float(log.u[i]),
            },
        )
