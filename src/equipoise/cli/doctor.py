"""`equipoise rig doctor`: checks whether machine and rig are fit for a run."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, verb
from equipoise.errors import InputError


class Measurement(Options):
    """Measurements."""

    seconds: Annotated[float, Field(ge=0.05, le=3600.0)] = 5.0
    """Duration of each measurement [s]."""
    load: bool = False
    """Measure again while every core is kept busy."""


@verb
def doctor(output: Output, *, rig: opt.Rig, measurement: Measurement) -> None:
    """Check whether machine and rig are fit for a run, and advise a cure.

    Nothing moves. The robot's answers are timed at rest, and its server ends
    with that session. Exit code 1: not fit.
    """
    from equipoise.rig.config import is_virtual, read_rig, restart_instruction
    from equipoise.rig.doctor import examine

    if rig.robot is not None and is_virtual(rig.robot):
        raise InputError(f"{rig.robot} has no link to time; give kst://HOST:30001")
    found = examine(
        rig.robot,
        rig.encoder,
        None if rig.rig is None else read_rig(rig.rig),
        seconds=measurement.seconds,
        load=measurement.load,
        logs=Path(),
        busy=output.busy,
        tell=output.tell,
    )
    spreads = {"deadlines": found.lateness, "with load": found.loaded, "robot": found.link}
    spreads["encoder"] = None if found.encoder is None else found.encoder.age
    output.result(
        verdict=found.verdict,
        delays={
            name: {"median_s": one.median, "p99_s": one.p99, "longest_s": one.most}
            for name, one in spreads.items()
            if one is not None
        },
        findings={
            one.name: {"verdict": one.verdict, "found": one.found, "cure": one.cure}
            for one in found.findings
        },
        restart=rig.robot and found.link and restart_instruction(rig.robot),
        code=int(found.verdict == "not fit"),
    )
