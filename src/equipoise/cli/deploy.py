"""Verbs of a run: `equipoise deploy`, and `console`, which shows it in the browser.

`deploy` runs a policy once, or moves an arm to measure its response: one program for a simulated
run, an emulated rig and a real rig.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import Field

import equipoise as eq
from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.errors import InputError
from equipoise.settings import HANGING, Start, changed
from equipoise.user_code import user_code


class RunOptions(opt.Options):
    """The run."""

    world: str = "twin:nominal"
    """World of a simulated run: twin:NAME ({worlds}), twin:FILE, or model."""
    duration: Annotated[float | None, Field(ge=0.01, le=3600.0)] = None
    """Duration [s]; by default 60, or 10 with --excite."""
    seed: opt.Seed = 0
    """Seed of the simulation."""
    start: Start | None = None
    """hand: released by hand (default); hanging: the arm swings it up."""
    excite: bool = False
    """Move every joint about home instead, with the pendulum hanging."""


class OnRig(opt.Rig):
    """A run on a rig."""

    dry_run: bool = False
    """Do everything except move."""
    max_speed: Annotated[float | None, Field(gt=0.0, le=2.0)] = None
    """Stop when the flange reaches this speed [m/s]."""
    identify: bool = False
    """Identify the arm before it balances, and use its response."""
    runs: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Number of runs in a row, with --start hanging: after a fall the arm begins the next one."""


@opt.verb
def deploy(
    output: Output,
    policy: Path | None = None,
    *,
    run: RunOptions,
    rig: OnRig,
    task: opt.Task,
    files: opt.Files,
) -> None:
    """Run a policy once, on a digital twin or on a rig, and write the log (run.mcap).

    POLICY is any policy that evaluate takes; by default the shipped table. With
    --robot or --rig it runs on a rig: pre-flight checks, a checklist that you
    acknowledge by typing, the move to home, a self-test, the release or
    swing-up of the pendulum, balancing, rest. Press any key to stop. Exit code
    1: the pendulum fell. Exit code 3: robot or encoder failed.

    With --runs, a fall or a run that survived leads to the next run without a
    hand: run-001.mcap and so on, and run-series.json. Any other end ends the
    series.

    With --excite the simulated arm moves without a policy, and equipoise
    identify fits an actuator to the log.
    """
    on_a_rig = any((rig.robot, rig.encoder, rig.rig))
    if run.excite and (policy or on_a_rig or task.actuator or task.settings):
        raise InputError("--excite moves a simulated arm; give it --arm and --pendulum alone")
    if on_a_rig:
        _run_on_rig(output, policy, run, task, rig, files)
    elif rig != OnRig():
        raise InputError("--dry-run, --max-speed, --identify and --runs need --robot")
    else:
        _simulate(output, policy, run, task, files)


def _simulate(
    output: Output, policy: Path | None, run: RunOptions, task: opt.Task, files: opt.Files
) -> None:
    """Simulate a run or an excitation, write the log, and print the result."""
    from equipoise.outcomes import Outcome

    if run.excite:
        arm, duration = opt.read_arm(task.arm or "iiwa7"), run.duration or 10.0
        simulated = partial(eq.excite, arm, pendulum=task.pendulum, duration=duration)
    else:
        loaded = task.read(policy)
        output.warn(loaded.shortfall)
        settings = changed(loaded.settings, {"evaluation.start": run.start})
        simulated = partial(
            eq.simulate_run,
            loaded,
            actuator=task.actuator,
            duration=run.duration,
            settings=settings,
        )
    out = files.file(output, "run.mcap", policy, task.pendulum)
    with output.busy("running"):
        log = simulated(world=run.world, seed=run.seed)
    log.save(out, command="deploy", inputs={} if run.excite else {"policy": log.conditions.policy})
    output.result(
        outcome=log.outcome,
        survival_s=log.survival,
        run=out,
        world=log.conditions.world,
        code=int(log.outcome not in (Outcome.SURVIVED, Outcome.EXCITED)),
        then=opt.command("identify" if run.excite else "log explain", out),
    )


def _run_on_rig(
    output: Output,
    policy: Path | None,
    run: RunOptions,
    task: opt.Task,
    rig: OnRig,
    files: opt.Files,
) -> None:
    """Run on an emulated or a real rig, write the log, and print the result."""
    from equipoise.cli.terminal_operator import TerminalOperator, single_keys
    from equipoise.control.bound_policy import BoundPolicy
    from equipoise.identification.actuator import identify_actuator
    from equipoise.log.conditions import RunEnd
    from equipoise.model.actuator import read_actuator
    from equipoise.outcomes import Outcome
    from equipoise.rig.checks import check_fit, check_swing_up, require
    from equipoise.rig.config import RigSettings, read_rig, world_of
    from equipoise.rig.connection import connect
    from equipoise.rig.processes import run_in_processes
    from equipoise.rig.request import RunRequest
    from equipoise.rig.run import run_virtually
    from equipoise.rig.series import run_path, summarise

    if run.world != RunOptions().world:
        raise InputError("--world is for a simulated run; leave it out, or leave out the rig")
    if rig.runs > 1 and run.start != HANGING:
        raise InputError("--runs needs --start hanging: a start by hand needs a hand each time")
    settings = read_rig(rig.rig)
    if task.arm is not None:
        of_the_arm: dict[str, object] = {"arm": task.arm}
        if Path(task.arm).suffix.lower() == ".toml":
            fields = {"arm", "held", "tip", "acceleration_deg", "home_deg", "pivot_mm"}
            of_the_arm = read_rig(Path(task.arm)).model_dump(include=fields)
        settings = RigSettings.model_validate({**dict(settings), **of_the_arm})
    robot = rig.robot or settings.robot
    if robot is None:
        raise InputError("the rig names no robot; give --robot")
    emulated = world_of(robot) is not None
    loaded = task.read(policy)
    if isinstance(loaded, BoundPolicy):
        loaded = replace(loaded, arm=settings.described_arm)
    output.warn(loaded.shortfall)
    request = RunRequest(
        loaded,
        loaded.actuator if task.actuator is None else read_actuator(task.actuator),
        settings,
        robot,
        rig.encoder if emulated else rig.encoder or settings.encoder,
        run.duration or 60.0,
        max_speed=rig.max_speed,
        dry_run=rig.dry_run,
        seed=run.seed,
        identify=identify_actuator if rig.identify else None,
        start=run.start or "hand",
        runs=rig.runs,
    )
    with output.busy("checking policy and addresses"):
        require(check_fit(request.policy, request.actuator, request.settings))
        swings = [check_swing_up(request)] if request.start == HANGING else []
        require(swings)
        with user_code(f"the driver of {robot}"):
            devices = connect(request)  # nothing is opened before the run
    for swing in swings:
        output.tell(swing.sentence)
    beside = ["-actuator.json"] if rig.identify else []
    beside += ["-series.json", "-001.mcap"] if request.runs > 1 else []
    read, ends = (policy, task.pendulum, rig.rig), list[RunEnd]()
    out = files.file(output, "run.mcap", *read, beside=beside)
    if emulated:
        with signals() as stopped, user_code(f"the driver of {robot}"):
            operator = TerminalOperator(output, stopped)
            end = run_virtually(request, out, operator, rig=devices, ended=ends.append)
    else:
        with single_keys():
            operator = TerminalOperator(output)
            end = run_in_processes(request, out, operator, operator.live, ended=ends.append)
    ends.append(end)
    last = run_path(out, len(ends), request.runs)
    actuator, then = None, opt.command("log explain", last)
    if (found := ends[0].identified) is not None:
        actuator = out.with_name(f"{out.stem}-actuator.json")
        found.save(actuator, command="deploy")
    if end.outcome is Outcome.DRY_RUN:
        then = opt.command("deploy", policy, run, rig.model_copy(update={"dry_run": False}), task)
    elif end.outcome is Outcome.UNIDENTIFIED and actuator is not None:
        pendulum = opt.file_of(loaded.pendulum.digest, eq.shipped_pendulum())
        arm = task.arm or rig.rig or opt.name_of(loaded.arm)
        then = opt.command("train", task.pendulum or pendulum, arm=arm, actuator=actuator)
    output.result(
        **(summarise(ends) if request.runs > 1 else {}),
        outcome=end.outcome,
        reason=end.reason,
        survival_s=end.survival,
        upright_s=end.upright,
        run=last,
        identified=found and found.summary,
        actuator=actuator,
        stoppable=end.stoppable,
        missed=end.missed,
        world=robot,
        code=0 if len(ends) == request.runs > 1 else end.exit_code,
        then=then,
    )


@opt.verb
def console(output: Output, *, page: opt.Page) -> None:
    """Show the runs on this computer in the browser, with all buttons, until Ctrl-C.

    Open the printed address, token included. The console shows each run on a
    real robot or on rig emulate that is started on this computer; log show
    replays a run in virtual time. STOP and the space bar stop the arm. A run
    does not depend on the console.
    """
    from equipoise.console.live import serve

    with signals() as stopped:
        serve(
            page.listen, page.port, lambda address: output.result(console=address), stopped.is_set
        )
