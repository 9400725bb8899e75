"""`equipoise log replay`: feeds a log through the controller again, and compares."""

from math import inf
from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output, verb


@verb
def replay(
    run: Path = opt.RUN,
    policy: Path | None = opt.POLICY,
    actuator: str | None = opt.KNOWN_ACTUATOR,
    pendulum: Path | None = opt.TASK_PENDULUM,
    arm: str | None = opt.TASK_ARM,
    tolerance: float = opt.value(
        "SI", "Tolerated difference of numbers; 0 compares every bit.", default=0.0
    ),
    as_json: bool = opt.JSON,
) -> None:
    """Feed the measurements of a log through the controller again, and compare.

    The log of a run on a rig holds every input of a tick. On the computer that
    made it, setpoints and states are the same bit for bit. Exit code 1: they
    differ; the first difference is printed.
    """
    output = Output(as_json)
    opt.check_range("--tolerance", tolerance, 0.0, inf)
    output.say(f"Replaying {run}")

    from equipoise.logs.run_log import RunLog
    from equipoise.studies.replay import replay as again

    log = RunLog.load(run, damaged=True)
    with output.busy("replaying"):
        found = again(
            log,
            opt.read_policy(policy, pendulum, arm, actuator),
            opt.read_actuator(actuator),
            tolerance=tolerance,
        )
    output.warn(log.missing_part)
    first = found.difference
    if first is None:
        same = "bit for bit" if found.largest == 0.0 else f"within {found.largest:.1g}"
        output.say(f"The same: {found.ticks:,} ticks, {same}.", style="green")
    else:
        output.say(
            f"Different: {found.ticks:,} ticks are the same; in the next, at {first.time:.3f} s, "
            f"{first.what} is {first.replayed!r}, and the log has {first.logged!r}.",
            style="red",
        )
    output.next("log", "explain", run)
    output.result(
        run=run,
        same=first is None,
        ticks=found.ticks,
        whole=found.whole,
        largest=found.largest,
        difference=None
        if first is None
        else {
            "tick": first.tick,
            "time_s": first.time,
            "what": first.what,
            "logged": repr(first.logged),
            "replayed": repr(first.replayed),
        },
        bad=first is not None,
    )
