"""`equipoise deploy`: a policy runs once, or an arm is moved to see how it follows."""

import shlex
from collections.abc import Callable
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli import next_step
from equipoise.cli.destinations import Destination, choose_file
from equipoise.cli.options import (
    IN_AND_OUT,
    Force,
    Json,
    KnownActuator,
    PolicyFile,
    Seed,
    read_actuator,
    read_arm,
    read_pendulum,
    read_policy,
)
from equipoise.cli.output import Output, stop_by_signal, verb
from equipoise.errors import EquipoiseError, InputError

if TYPE_CHECKING:
    from equipoise.cli.terminal_operator import TerminalOperator
    from equipoise.runlog import RunLog

NOT_BALANCED = 1
EXCITED = "To see how the arm follows"
ON_A_RIG = "On a rig"
LOG = "run.mcap"
"""Default name of a run's log."""
DURATION = 60.0
"""How long a run on a rig lasts, if nothing else is said [s]."""


@verb
def deploy(
    policy: PolicyFile = None,
    world: Annotated[
        str | None,
        typer.Option(
            metavar="WORLD",
            help="twin:nominal (the default), twin:harsh, twin:FILE; or model, the plant of the "
            "training.",
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Length of the run; 60, or 10 with --excite."),
    ] = None,
    actuator: KnownActuator = None,
    seed: Seed = 0,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="URI",
            help="kst://HOST:30001; or twin:nominal, the whole course on a digital twin.",
            rich_help_panel=ON_A_RIG,
        ),
    ] = None,
    encoder: Annotated[
        str | None,
        typer.Option(
            metavar="URI",
            help="serial:///dev/ttyACM0 or socket://HOST:PORT.",
            rich_help_panel=ON_A_RIG,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="TOML", help="What the rig is like.", rich_help_panel=ON_A_RIG),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Do all but move.", rich_help_panel=ON_A_RIG),
    ] = False,
    t1: Annotated[
        bool,
        typer.Option(
            "--t1", help="Stop where the flange reaches 0.23 m/s.", rich_help_panel=ON_A_RIG
        ),
    ] = False,
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
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The run log, MCAP.",
            rich_help_panel=IN_AND_OUT,
            show_default=LOG,
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Film of the run, MP4.", rich_help_panel=IN_AND_OUT),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Run a policy once, on a digital twin or on a rig, and write down what happens.

    With --robot it runs on a rig: links and limits are looked at, a checklist
    is acknowledged by typing, the arm goes home, tests itself, waits until the
    pendulum is let go, and balances. Any key stops it. Exit code 3 says that
    robot or encoder failed.

    With --excite the arm moves by itself: equipoise identify makes an actuator
    of that log. Exit code 1 says that the pendulum fell.
    """
    output = Output(as_json)
    if duration is not None and not 0.01 <= duration <= 3600.0:
        raise InputError(f"--duration is {duration:g} s; give a number from 0.01 to 3600")
    if robot is None and rig is not None:
        robot = _robot_of(rig)
    if robot is not None:
        if excite or arm is not None or pendulum is not None or world is not None:
            raise InputError("--excite, --arm, --pendulum and --world do not go with --robot")
        if video is not None:
            raise InputError(
                "--video does not go with --robot; film the log afterwards: "
                f"equipoise log export {shlex.quote(str(out or LOG))} "
                f"--video {shlex.quote(str(video))}"
            )
        log = choose_file(output, out, LOG, policy, rig, force=force, suffix=".mcap")
        code = _on_a_rig(
            output, policy, robot, encoder, rig, actuator, duration, dry_run, t1, seed, log
        )
        if code:
            raise typer.Exit(code)
        return
    if encoder is not None or dry_run or t1:
        raise InputError("--encoder, --dry-run and --t1 belong to a rig; give --robot")
    world = "twin:nominal" if world is None else world
    what = "Exciting the arm" if excite else f"Running {policy or 'the policy that ships'}"
    output.say(f"{what}, world {world}")
    log = choose_file(output, out, LOG, policy, pendulum, force=force, suffix=".mcap")
    film = None
    if video is not None:
        film = choose_file(
            output, video, video, policy, pendulum, force=force, suffix=".mp4", option="--video"
        )
        find_encoder()
    if excite:
        if policy is not None or actuator is not None or video is not None:
            raise InputError("POLICY, --actuator and --video do not go with --excite; leave them")
        run = _excite(output, arm or "iiwa7", pendulum, world, seed, duration)
    else:
        if arm is not None or pendulum is not None:
            raise InputError("--arm and --pendulum belong to --excite; a policy has its own")
        run = _run(output, policy, world, actuator, seed, duration)
    with log.claimed() as out:
        run.save(out, command="deploy", inputs={"policy": run.conditions.policy} if policy else {})
    _say(output, run)
    output.wrote(out)
    if film is not None:
        with film.claimed() as video:
            _film(output, run, policy, video)
        output.wrote(video)
    if excite:
        output.next("identify", out)
    else:
        output.next(*next_step.after_run(run, out, policy, world=world, actuator=actuator))
    fell = not excite and run.conditions.cause != "lasted"
    output.result(
        {
            "run": str(out),
            "world": run.conditions.world,
            "lasted_s": run.lasted,
            "cause": run.conditions.cause,
            "guard": run.conditions.guard or None,
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
    from equipoise.model.sim_configs import MODEL

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
) -> "RunLog":
    from equipoise.deployment import deploy

    table = read_policy(policy)
    response = read_actuator(actuator)
    with output.busy("running"):
        return deploy(table, world=world, actuator=response, seed=seed, duration=duration)


def _film(output: Output, run: "RunLog", policy: Path | None, video: Path) -> None:
    from equipoise.report.pictures import write_video

    with output.busy("drawing the film"):
        write_video(run, read_policy(policy).arm, video)


def _say(output: Output, run: "RunLog") -> None:
    from equipoise.model.sim_configs import PivotFriction

    conditions, truth = run.conditions, run.truth
    cause = conditions.cause + (f" ({conditions.guard})" if conditions.guard else "")
    rows = {"lasted": f"{run.lasted:g} s of {conditions.duration:g} s, ended: {cause}"}
    if len(truth.x):
        rows["flange"] = f"within {1e3 * float(abs(truth.x).max()):.0f} mm of home"
    if conditions.friction is not None:
        friction = PivotFriction.model_validate(conditions.friction)
        rows["pendulum"] = friction.words(conditions.world)
    if conditions.zero_error is not None and len(run.bias):
        rows["encoder's zero"] = (
            f"wrong by {degrees(conditions.zero_error):+.2f} deg, "
            f"estimated {degrees(run.bias[-1]):+.2f} deg"
        )
    if len(run.stream.time):
        rows["setpoints"] = f"{len(run.stream.time):,} sent"
    output.rows(rows)


def _robot_of(rig: Path) -> str:
    from equipoise.rigs import read_rig

    robot = read_rig(rig).robot
    if robot is None:
        raise InputError(f"{rig} does not say where the robot is; give --robot")
    return robot


def _on_a_rig(
    output: Output,
    policy: Path | None,
    robot: str,
    encoder: str | None,
    rig: Path | None,
    actuator: str | None,
    duration: float | None,
    dry_run: bool,
    t1: bool,
    seed: int,
    log: Destination,
) -> int:
    """Run on a rig, and return the exit code."""
    from equipoise.cli.terminal_operator import TerminalOperator, single_keys
    from equipoise.deployment.processes import run_in_processes
    from equipoise.deployment.rig import (
        RunRequest,
        check_request,
        exit_code,
        rehearse_t1,
        run_virtually,
    )
    from equipoise.rigs import check_addresses, is_virtual, read_rig

    settings = read_rig(rig)
    encoder = settings.encoder if encoder is None and not is_virtual(robot) else encoder
    check_addresses(robot, encoder)
    table = read_policy(policy)
    response = read_actuator(actuator)
    request = RunRequest(
        policy=table,
        actuator=table.actuator if response is None else response,
        settings=settings,
        robot=robot,
        encoder=encoder,
        duration=DURATION if duration is None else duration,
        t1=t1,
        dry_run=dry_run,
        seed=seed,
    )
    check_request(request)
    output.say(f"Running {policy or 'the policy that ships'} on {robot}")
    if (friction := request.friction) is not None:
        output.rows({"pendulum": friction.words(robot)})
    if t1:
        with output.busy("trying the policy in T1 on the twin"):
            rehearse_t1(request)
    console, out = TerminalOperator(output), log.path
    before = _identity(out)
    try:
        if is_virtual(robot):
            with stop_by_signal() as stopped:
                outcome = run_virtually(
                    request, out, Listening(console, stopped), replace=log.force
                )
        else:
            with single_keys():
                outcome = run_in_processes(request, out, console, replace=log.force)
    except EquipoiseError:
        if _identity(out) != before:
            output.wrote(out)
        raise
    told = {"ended": f"{outcome.cause}: {outcome.reason}", "balanced": f"{outcome.lasted:.2f} s"}
    for name, times in (("ticks late", outcome.late), ("compute time", outcome.compute)):
        if times:
            told[name] = ", ".join(f"{key} {1e3 * value:.2f} ms" for key, value in times.items())
    if outcome.missed:
        told["missed ticks"] = str(outcome.missed)
    output.rows(told)
    output.wrote(out)
    code = exit_code(outcome)
    if code:
        output.next("log", "explain", out)
    elif not dry_run:
        known = ("--actuator", actuator) if actuator else ()
        output.next("log", "replay", out, *((policy,) if policy else ()), *known)
    else:
        words = {"--encoder": encoder, "--rig": rig, "--actuator": actuator}
        given = [str(word) for pair in words.items() if pair[1] for word in pair]
        output.next("deploy", *((policy,) if policy else ()), "--robot", robot, *given)
    output.result({"run": str(out), "robot": robot, **outcome._asdict()})
    return code


def _identity(path: Path) -> int | None:
    """Return what tells a file from one that replaces it; none where there is no file."""
    return path.stat().st_ino if path.exists() else None


class Listening:
    """A console that is told, and speaks only by signals: an emulated operator types."""

    def __init__(self, console: "TerminalOperator", stopped: Callable[[], bool]) -> None:
        """Tell a console, and ask whether a signal came."""
        self.notify, self._stopped = console.notify, stopped

    def read_input(self) -> list[str]:
        """Return a stop, once a signal came."""
        return ["stop"] if self._stopped() else []
