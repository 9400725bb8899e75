"""`equipoise deploy`: a policy runs once, or an arm is moved to see how it follows."""

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli.options import (
    IN_AND_OUT,
    Json,
    KnownActuator,
    PolicyFile,
    Seed,
    check_output,
    read_actuator,
    read_arm,
    read_pendulum,
    read_policy,
)
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.runlog import RunLog

NOT_BALANCED = 1
EXCITED = "To see how the arm follows"


@verb
def deploy(
    policy: PolicyFile = None,
    world: Annotated[
        str,
        typer.Option(
            metavar="WORLD",
            help="twin:nominal, twin:harsh, twin:FILE, or model: the plant of the training.",
        ),
    ] = "twin:nominal",
    duration: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Length of the run; 60, or 10 with --excite."),
    ] = None,
    actuator: KnownActuator = None,
    seed: Seed = 0,
    excite: Annotated[
        bool,
        typer.Option(
            "--excite",
            help="Move every joint about home instead, the pendulum hanging.",
            rich_help_panel=EXCITED,
        ),
    ] = False,
    arm: Annotated[
        str | None,
        typer.Option(
            metavar="ARM", help="iiwa7 or iiwa14, with --excite.", rich_help_panel=EXCITED
        ),
    ] = None,
    pendulum: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="That hangs on it, with --excite.", rich_help_panel=EXCITED
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="The run log, MCAP.", rich_help_panel=IN_AND_OUT),
    ] = Path("run.mcap"),
    video: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Film of the run, MP4.", rich_help_panel=IN_AND_OUT),
    ] = None,
    as_json: Json = False,
) -> None:
    """Run a policy once on a digital twin, and write down what happens.

    With --excite the arm moves by itself: equipoise identify makes an actuator
    of that log. Exit code 1 says that the pendulum fell.
    """
    output = Output(as_json)
    what = "Exciting the arm" if excite else f"Running {policy or 'the policy that ships'}"
    output.say(f"{what}, world {world}")
    check_output(out, policy, pendulum, suffix=".mcap")
    if video is not None:
        check_output(video, policy, pendulum, suffix=".mp4", option="--video")
    if duration is not None and not 0.01 <= duration <= 3600.0:
        raise InputError(f"--duration is {duration:g} s; give a number from 0.01 to 3600")
    if excite:
        if policy is not None or actuator is not None or video is not None:
            raise InputError("POLICY, --actuator and --video do not go with --excite; leave them")
        run = _excite(output, arm or "iiwa7", pendulum, world, seed, duration)
    else:
        if arm is not None or pendulum is not None:
            raise InputError("--arm and --pendulum belong to --excite; a policy has its own")
        run = _run(output, policy, world, actuator, seed, duration, video)
    run.save(out, command="deploy", inputs={"policy": run.conditions.policy} if policy else {})
    _say(output, run)
    output.wrote(*(path for path in (out, video) if path is not None))
    if excite:
        output.next("identify", out)
    else:
        output.next("evaluate", *((policy,) if policy else ()), "--world", world)
    fell = not excite and run.conditions.cause != "lasted"
    output.result(
        {
            "run": str(out),
            "world": run.conditions.world,
            "lasted_s": run.lasted,
            "cause": run.conditions.cause,
            "ticks": len(run.time),
            "setpoints": len(run.stream.time),
            "video": str(video) if video else None,
        }
    )
    if fell:
        raise typer.Exit(NOT_BALANCED)


def _excite(
    output: Output,
    arm: str,
    pendulum: Path | None,
    world: str,
    seed: int,
    duration: float | None,
) -> "RunLog":
    from equipoise.deployment import excite
    from equipoise.model.worlds import MODEL

    if world == MODEL:
        raise InputError(f"the world {MODEL} has no servo to excite; give a twin")
    with output.busy("moving the arm"):
        return excite(
            read_arm(arm),
            world,
            read_pendulum(pendulum),
            seed=seed,
            duration=10.0 if duration is None else duration,
        )


def _run(
    output: Output,
    policy: Path | None,
    world: str,
    actuator: str | None,
    seed: int,
    duration: float | None,
    video: Path | None,
) -> "RunLog":
    from equipoise.deployment import deploy

    table = read_policy(policy)
    response = read_actuator(actuator)
    with output.busy("running") as rename:
        run = deploy(table, world=world, actuator=response, seed=seed, duration=duration)
        if video is not None:
            from equipoise.report.pictures import write_video

            rename("drawing the film")
            write_video(run, table.arm, video)
        return run


def _say(output: Output, run: "RunLog") -> None:
    conditions, truth = run.conditions, run.truth
    rows = {"lasted": f"{run.lasted:g} s of {conditions.duration:g} s, ended: {conditions.cause}"}
    if len(truth.x):
        rows["flange"] = f"within {1e3 * float(abs(truth.x).max()):.0f} mm of home"
    if conditions.zero_error is not None and len(run.bias):
        rows["encoder's zero"] = (
            f"wrong by {degrees(conditions.zero_error):+.2f} deg, "
            f"estimated {degrees(run.bias[-1]):+.2f} deg"
        )
    if len(run.stream.time):
        rows["setpoints"] = f"{len(run.stream.time):,} sent"
    output.rows(rows)
