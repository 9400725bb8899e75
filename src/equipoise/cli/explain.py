"""`equipoise log explain`: why did a run end?"""

from math import degrees
from typing import TYPE_CHECKING

from equipoise import paper
from equipoise.cli import next_step
from equipoise.cli.options import Json, RunFile
from equipoise.cli.output import Output, verb

if TYPE_CHECKING:
    from rich.table import Table

    from equipoise.runlog import RunLog

ROWS = 12
"""Rows of the picture of the end."""
SHOWN = 1.1
"""So much of the run it shows [s]."""
WIDTH = 15
"""Places of a bar, odd."""
HEADER = {
    "t [s]": "",
    "phi [deg]": f"within {paper.PHI_LIMIT_DEG:g} deg",
    "x [m]": f"within {paper.X_LIMIT:g} m",
    "u [m/s^2]": "",
}
"""Columns, and what the bar beside one is about."""


@verb
def explain(
    run: RunFile,
    as_json: Json = False,
) -> None:
    """Say why a run ended: causes that its log speaks for, the most likely first.

    It looks at release, pushes, the encoder and its zero, lateness, commands
    and guards, and says what to do. A log that breaks off is read as far as
    it goes.
    """
    output = Output(as_json)
    output.say(f"Explaining {run}")

    from equipoise.runlog import RunLog
    from equipoise.studies.explanation import explain as why
    from equipoise.studies.runs import missing_part, read_any

    read = read_any(run)
    found, missing = why(read), missing_part(read)
    first, *others = found.causes
    how, log = found.ending, found.log
    rows = {"ended": f"{how.cause}{f': {how.reason}' if how.reason else ''}"}
    if how.phase is not None:
        rows["while"] = how.phase.value
    if log is not None and len(log.time):
        rows["balanced"] = f"{log.lasted:.2f} s of {log.conditions.duration:g} s"
    output.rows(rows)
    if missing:
        output.warn(missing)
    output.say()
    output.say(f"Why: {first.name.value}", style="bold")
    output.rows({"evidence": first.evidence, "what to do": first.advice})
    if others:
        output.say()
        output.say("Less likely, or what followed from it:")
        output.rows({one.name.value: one.evidence for one in others})
    if log is not None and len(log.time) > 1:
        output.say()
        output.say(_picture(log))
    if isinstance(read, RunLog):
        who, ticks = read.conditions.policy, len(read.time)
    else:
        who, ticks = str(read.conditions["policy"]), len(read.tables["tick"])
    output.next(*next_step.after_explanation(run, who, moved=ticks > 0))
    output.result(
        {
            "run": str(run),
            "cause": first.name.value,
            "causes": [
                {
                    "name": one.name.value,
                    "score": one.score,
                    "time_s": one.time,
                    "evidence": one.evidence,
                    "advice": one.advice,
                }
                for one in found.causes
            ],
            "ended": how.cause,
            "reason": how.reason,
            "whole": how.whole,
            "lasted_s": None if log is None else log.lasted,
        }
    )


def _picture(log: "RunLog") -> "Table":
    """Return the last second as a table with bars."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 1), header_style="dim")
    for title, within in HEADER.items():
        table.add_column(title, justify="right", no_wrap=True)
        if within:
            table.add_column(within, no_wrap=True)
    last = len(log.time) - 1
    step = max(round(min(SHOWN, log.lasted) / log.conditions.h / (ROWS - 1)), 1)
    for i in sorted({max(last - step * back, 0) for back in range(ROWS)}):
        phi, x = degrees(log.estimated_phi[i]), float(log.x[i])
        table.add_row(
            f"{log.time[i]:.2f}",
            f"{phi:+.1f}",
            _bar(phi / paper.PHI_LIMIT_DEG),
            f"{x:+.3f}",
            _bar(x / paper.X_LIMIT),
            f"{log.u[i]:+.1f}",
        )
    return table


def _bar(share: float) -> str:
    """Return a line with a mark, -1 at its left end, 1 at its right."""
    middle = WIDTH // 2
    places = [" "] * WIDTH
    places[middle] = "|"
    places[middle + round(max(min(share, 1.0), -1.0) * middle)] = "o"
    return f"[{''.join(places)}]"
