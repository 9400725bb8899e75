"""`equipoise log explain`: explains why a run ended."""

from pathlib import Path

from equipoise.cli.output import Output
from equipoise.cli.verb import verb


@verb
def explain(output: Output, run: Path) -> None:
    """Explain why a run ended: causes with their evidence, the most likely first.

    Examines release, pushes, the encoder's zero, commands and safety rules,
    and gives advice. A truncated log is read as far as it is readable.
    """
    from equipoise.logs.run_log import RunLog
    from equipoise.outcomes import describe
    from equipoise.rig.explanation import explain as why

    read = RunLog.load(run, damaged=True)
    causes, end = why(read), read.ending
    output.result(
        warnings=[read.damage],
        outcome=end.outcome,
        reason=describe(end),
        phase=None if read.conditions.simulated else read.last_phase and read.last_phase.value,
        whole=read.end is not None,
        lasted_s=causes[0].time and read.lasted,
        cause=causes[0].cause,
        advice=causes[0].advice,
        causes={
            str(one.cause): {"score": one.score, "time_s": one.time, "evidence": one.evidence}
            for one in causes
        },
        then="log show RUN",
    )
