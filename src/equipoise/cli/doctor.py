"""`equipoise rig doctor`: checks whether machine and rig are fit for a run."""

from typing import Annotated

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.options import Options, command, verb
from equipoise.cli.output import Output
from equipoise.errors import InputError


class Measurement(Options):
    """Measurements."""

    seconds: Annotated[float, Field(ge=0.05, le=3600.0)] = 5.0
    """Duration of each measurement [s]."""


@verb
def doctor(output: Output, *, rig: opt.Rig, measurement: Measurement) -> None:
    """Check whether machine and rig are fit for a run, and advise a fix.

    Nothing moves; the robot's answers are timed at rest. Exit code 1: not fit.
    """
    from equipoise.rig.checks import examine
    from equipoise.rig.clocks import SystemClock
    from equipoise.rig.config import read_rig, world_of
    from equipoise.rig.connection import open_encoder
    from equipoise.rig.plugins import Session, robot_plugin

    robot, encoder = rig.robot, rig.encoder
    if robot is not None and world_of(robot):
        raise InputError(f"{robot} has no link to time; give the address of a real robot")
    clock, plugin, device = SystemClock(), None, None
    if robot is not None:
        plugin = robot_plugin(robot)
        device = plugin.open(robot, Session(clock, clock, notify=output.tell))
    with output.busy("measuring"):
        findings = examine(
            device,
            None if encoder is None else open_encoder(encoder, clock),
            None if rig.rig is None else read_rig(rig.rig),
            measurement.seconds,
            paced=plugin is not None and plugin.paced,
        )
    fit = all(one.status != "bad" for one in findings)
    output.result(
        verdict="fit" if fit else "not fit",
        findings={
            one.name: {"status": one.status, "found": one.found, "remedy": one.remedy}
            for one in findings
        },
        restart=plugin and plugin.restart,
        code=int(not fit),
        then=command("deploy", rig, dry_run=True) if fit and robot else "",
    )
