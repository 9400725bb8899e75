"""`equipoise deploy`: runs a policy once, or moves an arm to measure its response.

One program for a simulated run, an emulated rig and a real rig: check the options, choose the names
of the files, run, then report the result, the files and the next command.
"""

from collections.abc import Callable
from dataclasses import replace
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from equipoise.cli import options as opt
from equipoise.cli.destinations import Destination, choose_file
from equipoise.cli.export import choose_film, draw_film
from equipoise.cli.output import Output, stop_by_signal, verb
from equipoise.errors import EquipoiseError, InputError
from equipoise.outcomes import Outcome
from equipoise.user_code import guest_code

if TYPE_CHECKING:
    from equipoise.cli.terminal_operator import TerminalOperator
    from equipoise.logs.run_log import RunLog
    from equipoise.rig.run import RunRequest

EXCITATION = "To identify the arm"
LOG = "run.mcap"
"""Default name of a run's log."""
DURATION = 60.0
"""Default duration of a run on a rig [s]."""
EXCITATION_DURATION = 10.0
"""Default duration of an excitation [s]."""
TASK = ("actuator", "pendulum", "arm", "settings_file")
OPTIONS = {
    "--robot": (
        "policy",
        "robot",
        "encoder",
        "rig",
        *TASK,
        "dry_run",
        "t1",
        "identify",
        "anyway",
        "video",
        "console",
    ),
    "--excite": ("excite", "world", "arm", "pendulum"),
    "a simulated run": ("policy", "world", *TASK, "video"),
}
"""Options of each mode, besides those of all modes."""
RIG_FIELDS = ("outcome", "reason", "stoppable", "zero", "missed", "late", "compute")
"""Fields of the JSON object about the end of a run on a rig, by their names in `RunEnd`."""
OF_ALL_MODES = ("duration", "seed", "out", "force", "as_json")


class _Report(NamedTuple):
    """Result of a run, for the last lines of the verb."""

    rows: dict[str, str]
    """Lines of the result."""
    fields: dict[str, Any]
    """Fields of the JSON object, besides the names of the files."""
    code: int
    """Exit code."""


@verb
def deploy(
    context: typer.Context,
    policy: Path | None = opt.POLICY,
    world: str = opt.value(
        "WORLD",
        "twin:nominal, twin:harsh, twin:FILE; or model, the plant of the training.",
        default="twin:nominal",
    ),
    duration: float | None = opt.value("SECONDS", "Duration of the run; 60, or 10 with --excite."),
    actuator: str | None = opt.KNOWN_ACTUATOR,
    seed: int = opt.SEED,
    robot: str | None = opt.value(
        "URI", "kst://HOST:30001; or twin:nominal, an emulated rig.", panel=opt.RIG_PANEL
    ),
    encoder: str | None = opt.ENCODER,
    rig: Path | None = opt.RIG,
    dry_run: bool = opt.flag("--dry-run", "Do everything except move.", panel=opt.RIG_PANEL),
    t1: bool = opt.flag("--t1", "Stop where the flange reaches 0.23 m/s.", panel=opt.RIG_PANEL),
    identify: bool = opt.flag(
        "--identify",
        "Move every joint for ten seconds before the lift, and assume the response identified from "
        "it.",
        panel=opt.RIG_PANEL,
    ),
    anyway: bool = opt.flag(
        "--anyway",
        "Run also a table that lasted less than 92.5 % of its training's final round, or one that "
        "does not fit the identified arm.",
        panel=opt.RIG_PANEL,
    ),
    console: bool = opt.flag(
        "--console",
        "Show the run in the browser, with a button for each answer and a STOP.",
        panel=opt.RIG_PANEL,
    ),
    excite: bool = opt.flag(
        "--excite", "Move every joint about home instead, the pendulum hanging.", panel=EXCITATION
    ),
    pendulum: Path | None = opt.TASK_PENDULUM,
    arm: str | None = opt.TASK_ARM,
    settings_file: Path | None = opt.SETTINGS_FILE,
    out: Path | None = opt.out("Run log to write, MCAP.", LOG),
    video: Path | None = opt.value("FILE", "Film of the run, .mp4 or .webp.", panel=opt.IN_AND_OUT),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Run a policy once, on a digital twin or on a rig, and write the log.

    With --robot it runs on a rig: pre-flight checks, a checklist that is
    acknowledged by typing, the move to home, a self-test, the release of the
    pendulum, balancing, rest. Any key stops it. Exit code 3: robot or encoder
    failed.

    With --excite the arm moves by itself, and equipoise identify makes an
    actuator of the log. Exit code 1: the pendulum fell.
    """
    output = Output(as_json)
    opt.check_range("--duration", duration, 0.01, 3600.0, " s")
    if rig is not None and not excite:
        from equipoise.rig.config import is_virtual, read_rig

        settings = read_rig(rig)
        robot = robot or settings.robot
        if robot is None:
            raise InputError(f"{rig} does not name the robot; give --robot")
        encoder = encoder if is_virtual(robot) else encoder or settings.encoder
    mode = "--robot" if robot is not None else "--excite" if excite else "a simulated run"
    hint = "give --robot for a rig, --excite for an arm, or leave it out"
    opt.only(
        context, mode, *OPTIONS[mode], *OF_ALL_MODES, hint="" if mode.startswith("-") else hint
    )
    what = "Exciting the arm" if excite else f"Running {policy or 'the shipped policy'}"
    output.say(f"{what} on {robot or world}")
    inputs = (policy, pendulum, rig)

    def beside(path: Path) -> tuple[Path, ...]:
        return (_actuator_file(path),) if identify else ()

    log = choose_file(output, out, LOG, *inputs, force=force, suffix=".mcap", beside=beside)
    film = None if video is None else choose_film(output, video, *inputs, force=force)
    response = opt.read_actuator(actuator)
    if robot is not None:
        from equipoise.control.bound_policy import BoundPolicy
        from equipoise.identification.actuator import identify_motion
        from equipoise.rig.config import read_rig
        from equipoise.rig.run import RunRequest, require_survival

        described, length = read_rig(rig), duration or DURATION
        chosen = opt.read_policy(policy, pendulum, arm, actuator, settings_file)
        if arm is None and isinstance(chosen, BoundPolicy):
            chosen = replace(chosen, arm=described.described_arm)
        output.warn(opt.shortfall(chosen))
        if not anyway:
            require_survival(chosen)
        carried = chosen.actuators if response is None else (response,)
        options: Any = {"t1": t1, "dry_run": dry_run, "seed": seed, "alternatives": carried[1:]}
        options |= {"identify": identify_motion if identify else None, "anyway": anyway}
        request = RunRequest(chosen, carried[0], described, robot, encoder, length, **options)
        out = log.path
        report = _run_on_rig(output, request, log, console=console)
    else:
        from equipoise.rig import simulate

        chosen = None
        if not excite:
            chosen = opt.read_policy(policy, pendulum, arm, actuator, settings_file)
            output.warn(opt.shortfall(chosen))
        with output.busy("moving the arm" if excite else "running"):
            if chosen is None:
                excited, hanging = opt.read_arm(arm or "iiwa7"), opt.read_pendulum(pendulum)
                length = duration or EXCITATION_DURATION
                run = simulate.excite(excited, world, hanging, seed=seed, duration=length)
            else:
                run = simulate.simulate_run(
                    chosen, world=world, actuator=response, seed=seed, duration=duration
                )
        with log.claimed() as out:
            made_from = {} if excite else {"policy": run.conditions.policy}
            run.save(out, command="deploy", inputs=made_from)
        report = _report(run)
    output.rows(report.rows)
    output.wrote(out)
    if film is not None and report.code in (0, 1):
        video = draw_film(output, out, film)
        output.wrote(video)
    output.next(*(("identify", out) if excite else ("log", "explain", out)))
    output.result(run=out, **report.fields, video=video)
    if report.code:
        raise typer.Exit(report.code)


def _report(run: "RunLog") -> _Report:
    """Return the report of a simulated run or an excitation."""
    from equipoise.model.worlds import PivotFriction

    conditions, truth = run.conditions, run.truth
    rows = {"lasted": f"{run.lasted:g} s of {conditions.duration:g} s, ended: {run.outcome}"}
    if len(truth.x):
        rows["flange"] = f"within {1e3 * float(abs(truth.x).max()):.0f} mm of home"
    if conditions.friction is not None:
        friction = PivotFriction.model_validate(conditions.friction)
        rows["pendulum"] = friction.describe(conditions.world)
    if conditions.zero_error is not None and len(run.bias):
        rows["encoder's zero"] = (
            f"wrong by {degrees(conditions.zero_error):+.2f} deg, "
            f"estimated {degrees(run.bias[-1]):+.2f} deg"
        )
    if len(run.stream.time):
        rows["setpoints"] = f"{len(run.stream.time):,} sent"
    fields = {
        "world": conditions.world,
        "lasted_s": run.lasted,
        "outcome": run.outcome,
        "ticks": len(run.time),
        "setpoints": len(run.stream.time),
    }
    good = run.outcome == Outcome.LASTED or not conditions.policy
    return _Report(rows, fields, 0 if good else 1)


def _run_on_rig(
    output: Output,
    request: "RunRequest",
    log: Destination,
    *,
    console: bool,
) -> _Report:
    """Run on an emulated or a real rig, and write the log."""
    from equipoise.cli.console import beside
    from equipoise.cli.terminal_operator import TerminalOperator, single_keys
    from equipoise.rig.config import is_virtual
    from equipoise.rig.processes import run_in_processes
    from equipoise.rig.run import check_request, rehearse_t1, run_virtually

    check_request(request)
    if console and is_virtual(request.robot):
        raise InputError(
            f"--console shows a run in real time, and {request.robot} runs in virtual time; start "
            "equipoise rig emulate, and give the --robot and --encoder that it prints"
        )
    if (friction := request.friction) is not None:
        output.rows({"pendulum": friction.describe(request.robot)})
    if request.t1:
        with output.busy("testing the policy in T1 on the twin"):
            rehearse_t1(request)
    out, person = log.path, TerminalOperator(output)
    before = _identity(out)
    try:
        if is_virtual(request.robot):
            with stop_by_signal() as stopped, guest_code(f"the driver of {request.robot}"):
                spectator = _Spectator(person, stopped)
                result = run_virtually(request, out, spectator)
        else:
            with beside(output, console), single_keys():
                result = run_in_processes(request, out, person)
    except EquipoiseError:
        if _identity(out) != before:
            output.wrote(out)
        raise
    lasted = result.lasted or 0.0
    rows = {"ended": f"{result.outcome}: {result.reason}", "balanced": f"{lasted:.2f} s"}
    for name, times in (("ticks late", result.late), ("compute time", result.compute)):
        if times:
            rows[name] = ", ".join(f"{key} {1e3 * value:.2f} ms" for key, value in times.items())
    if result.missed:
        rows["missed ticks"] = str(result.missed)
    code, identified = result.exit_code, result.identified
    if identified is not None:
        identified.save(_actuator_file(out), command="deploy", inputs={})
        rows["identified"] = f"{identified.summary}, in {_actuator_file(out)}"
    fields = result.model_dump(include=set(RIG_FIELDS))
    return _Report(rows, {"world": request.robot, "lasted_s": lasted, **fields}, code)


def _actuator_file(log: Path) -> Path:
    """Return the path of the actuator that a run identifies."""
    return log.with_name(f"{log.stem}-actuator.json")


def _identity(path: Path) -> int | None:
    """Return the number of a file, which differs from that of a replacement; None: no file."""
    return path.stat().st_ino if path.exists() else None


class _Spectator:
    """Operator who receives messages, and can stop the run by a signal only."""

    def __init__(self, person: "TerminalOperator", stopped: Callable[[], bool]) -> None:
        self.notify, self._stopped = person.notify, stopped

    def read_input(self) -> list[str]:
        """Return a stop after a signal."""
        return ["stop"] if self._stopped() else []
