"""`equipoise log explain`: explains why a run ended."""

from collections.abc import Iterator
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

from equipoise import paper
from equipoise.cli import options as opt
from equipoise.cli.output import Output, gauge, verb

if TYPE_CHECKING:
    from equipoise.logs.run_log import RunLog

ROWS = 12
"""Number of rows of the picture of the end."""
SHOWN = 1.1
"""Duration of the picture of the end [s]."""
WIDTH = 15
"""Width of a bar, in characters; odd."""
COLUMNS = (
    "t [s]",
    "phi [deg]",
    f"within {paper.PHI_LIMIT_DEG:g} deg<",
    "x [m]",
    f"within {paper.X_LIMIT:g} m<",
    "u [m/s^2]",
)


@verb
def explain(run: Path = opt.RUN, as_json: bool = opt.JSON) -> None:
    """Explain why a run ended: causes with their evidence, the most likely first.

    Examines release, pushes, the encoder and its zero, lateness, commands and
    safety rules, and gives advice. A truncated log is read as far as it is
    readable.
    """
    output = Output(as_json)
    output.say(f"Explaining {run}")

    from equipoise.logs.run_log import RunLog
    from equipoise.outcomes import describe
    from equipoise.rig.explanation import explain as why

    read = RunLog.load(run, damaged=True)
    found, missing = why(read), read.damage
    first, *others = found.causes
    log = found.log
    reason = describe(found.end)
    rows = {"ended": f"{found.end.outcome}: {reason}"}
    if (phase := read.last_phase) is not None and not read.conditions.simulated:
        rows["while"] = phase.value
    if log is not None and len(log.time):
        rows["balanced"] = f"{log.lasted:.2f} s of {log.conditions.duration:g} s"
    output.rows(rows)
    output.warn(missing)
    output.say()
    output.say(f"Why: {first.cause}", style="bold")
    output.rows({"evidence": first.evidence, "what to do": first.advice})
    if others:
        output.say()
        output.say("Less likely, or a consequence:")
        output.rows({str(one.cause): one.evidence for one in others})
    if log is not None and len(log.time) > 1:
        output.say()
        output.table(COLUMNS, _picture(log))
    output.next("log", "export", run)
    output.result(
        run=run,
        cause=first.cause,
        causes=[
            {"name": one.cause, "time_s": one.time}
            | {field: getattr(one, field) for field in ("score", "evidence", "advice")}
            for one in found.causes
        ],
        ended=found.end.outcome,
        reason=reason,
        whole=read.end is not None,
        lasted_s=None if log is None else log.lasted,
    )


def _picture(log: "RunLog") -> Iterator[tuple[str, ...]]:
    """Yield the last second as rows with bars."""
    last = len(log.time) - 1
    step = max(round(min(SHOWN, log.lasted) / log.conditions.h / (ROWS - 1)), 1)
    for i in sorted({max(last - step * back, 0) for back in range(ROWS)}):
        phi, x = degrees(log.estimated_phi[i]), float(log.x[i])
        yield (
            f"{log.time[i]:.2f}",
            f"{phi:+.1f}",
            f"[{gauge(phi / paper.PHI_LIMIT_DEG, WIDTH)}]",
            f"{x:+.3f}",
            f"[{gauge(x / paper.X_LIMIT, WIDTH)}]",
            f"{log.u[i]:+.1f}",
        )
