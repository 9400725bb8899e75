"""`equipoise rig doctor`: checks whether machine and rig are fit for a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.cli import options as opt
from equipoise.cli.output import VERDICT_STYLES, Output, verb
from equipoise.errors import InputError
from equipoise.printable import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equipoise.rig.findings import Finding

FITNESS_STYLES: Final = {"fit": "green", "usable with care": "yellow", "not fit": "red"}
"""Styles of the verdict on machine and rig."""


@verb
def doctor(
    seconds: float = opt.value("S", "Duration of each measurement.", default=5.0),
    robot: str | None = opt.ROBOT,
    encoder: str | None = opt.ENCODER,
    rig: Path | None = opt.RIG,
    logs: Path = opt.value(
        "FOLDER", "Folder of the run logs.", panel=opt.IN_AND_OUT, default=Path()
    ),
    as_json: bool = opt.JSON,
) -> None:
    """Check whether machine and rig are fit for a run, and advise a cure.

    Nothing moves. The robot's answers are timed at rest, and its server ends
    with that session. Exit code 1: not fit.
    """
    opt.check_range("--seconds", seconds, 0.05, 3600.0, " s")
    if logs.is_file():
        raise InputError(f"--logs is the file {logs}; give the name of a folder")
    output = Output(as_json)
    examined = "this machine" if robot is None and encoder is None else "machine and rig"
    output.say(f"Examining {examined}; nothing moves")

    from equipoise.rig.checks import examine
    from equipoise.rig.clocks import SystemClock
    from equipoise.rig.config import read_rig
    from equipoise.rig.connection import (
        open_encoder,
        open_robot,
        restart_instruction,
        world_of,
    )
    from equipoise.rig.findings import fitness

    if robot is not None and world_of(robot):
        raise InputError(
            f"{robot} has no link to time; give kst://HOST:30001, such as that of equipoise rig "
            "emulate"
        )
    clock, settings = SystemClock(), None if rig is None else read_rig(rig)
    findings = examine(
        None if robot is None else open_robot(robot, clock, tell=output.say),
        None if encoder is None else open_encoder(encoder, clock),
        settings,
        seconds=seconds,
        logs=logs,
        busy=output.busy,
    )
    verdict = fitness(findings)
    _say(output, findings)
    output.say(f"\nVerdict on {examined}: {verdict}.", style=FITNESS_STYLES[verdict])
    output.say("What each line means: docs/how-to/real-time.md", style="dim")
    if robot is not None and (restart := restart_instruction(robot)):
        output.say(f"This session with the robot has ended; before the next one, {restart}.")
    dumped = [finding.model_dump(mode="json") for finding in findings]
    output.result(verdict=verdict, findings=dumped, bad=verdict == "not fit")


def _say(output: Output, findings: "Sequence[Finding]") -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    for finding in findings:
        status = Text(f"  {finding.status}", style=VERDICT_STYLES[finding.status])
        table.add_row(status, finding.name, printable(finding.text))
        if finding.remedy:
            table.add_row("", "", Text(f"-> {printable(finding.remedy)}", style="italic"))
    output.say()
    output.say(table)
