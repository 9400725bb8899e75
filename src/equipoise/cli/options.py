"""Options that several verbs share, their checks, and the values that they name."""

import shlex
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TaskPolicy
    from equipoise.model.actuator import Actuator
    from equipoise.model.arms.arm import Arm
    from equipoise.model.pendulum import Pendulum

LARGEST_SEED = 2**32 - 1

IN_AND_OUT = "Files and settings"
URDF = "For an arm from a URDF"
RECORDING = "The recording"
RIG = "The rig"
"""Titles of panels in the help."""


def value(metavar: str, help: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """Return the declaration of an option with a value.

    Args:
        metavar: Name of the value in the help.
        help: Text of the help.
        names: Names of the option; by default that of the parameter.
        panel: Title of its panel in the help.
        more: Further arguments of `typer.Option`.
    """
    return typer.Option(*names, metavar=metavar, help=help, rich_help_panel=panel, **more)


def flag(names: str, help: str, panel: str | None = None) -> Any:
    """Return the declaration of an option without a value."""
    return typer.Option(names, help=help, rich_help_panel=panel, metavar="")


def out(what: str, default: str | bool, metavar: str = "FILE") -> Any:
    """Return the declaration of `--out`, with its default name for the help."""
    return value(metavar, what, panel=IN_AND_OUT, show_default=default)


def _seed(seed: int) -> int:
    if not 0 <= seed <= LARGEST_SEED:
        raise typer.BadParameter(f"{seed} is not from 0 to {LARGEST_SEED}.")
    return seed


Json = Annotated[bool, flag("--json", "Print one JSON object and nothing else.", panel=IN_AND_OUT)]
Force = Annotated[
    bool, flag("--force", "Replace existing files; otherwise they are kept.", panel=IN_AND_OUT)
]
Resume = Annotated[
    bool,
    flag(
        "--resume",
        "Continue the interrupted training of this output, to the same result.",
        panel=IN_AND_OUT,
    ),
]
SettingsFile = Annotated[
    Path | None, value("TOML", "Settings, one table per section.", "--settings", panel=IN_AND_OUT)
]
Set = Annotated[
    list[str] | None, value("NAME=VALUE", "One setting; repeatable.", "--set", panel=IN_AND_OUT)
]
Recipe = Annotated[str, value("NAME", "robust, or paper: the most literal reading of its text.")]
MaxSpeed = Annotated[
    float | None, value("M/S", "Flange speed limit of a trial (T1: 0.23; default: none).")
]

Start = Annotated[
    float | None,
    value("SECONDS", "Begin here; by default at the detected release.", panel=RECORDING),
]
End = Annotated[float | None, value("SECONDS", "End here.", panel=RECORDING)]
CountsPerRev = Annotated[
    int | None, value("N", "Encoder counts per revolution, after x4.", min=1, panel=RECORDING)
]
Columns = Annotated[
    str | None,
    value(
        "NAMES",
        "Names of all columns in order, e.g. time_s,theta_deg; for a file without a header, or "
        "with other names.",
        panel=RECORDING,
    ),
]
FromUpright = Annotated[
    bool, flag("--from-upright", "The recorded angle is zero when upright.", panel=RECORDING)
]

Seed = Annotated[int, value("N", "Master seed; equal seeds give equal results.", callback=_seed)]
Workers = Annotated[
    int | None,
    value("N", "Threads, by default one per core; results do not depend on them.", min=1),
]
ArmName = Annotated[
    str, value("ARM", "iiwa7, iiwa14, another registered arm, a URDF or a rig.toml.", "--arm")
]
ActuatorFile = Annotated[
    str | None,
    value(
        "FILE",
        "From equipoise identify RUN.mcap, or ideal; by default the shipped actuator.",
        "--actuator",
    ),
]
KnownActuator = Annotated[
    str | None,
    value("FILE", "Actuator that the controller assumes; by default the policy's.", "--actuator"),
]
PolicyFile = Annotated[
    Path | None,
    typer.Argument(
        metavar="POLICY",
        help="Table from equipoise train, network (.onnx), Python MODULE:NAME, lqr, lqr-snapped, "
        "pd or random; by default the shipped table.",
        show_default=False,
    ),
]
TaskPendulum = Annotated[
    Path | None,
    value("FILE", "Pendulum; by default the table's, or the shipped one.", "--pendulum"),
]
TaskArm = Annotated[
    str | None, value("ARM", "Arm; by default the table's, the rig's, or iiwa7.", "--arm")
]
RunFile = Annotated[
    Path, typer.Argument(metavar="RUN", help="Log from equipoise deploy.", show_default=False)
]
RobotUri = Annotated[str | None, value("URI", "Robot: kst://HOST:30001.", "--robot", panel=RIG)]
EncoderUri = Annotated[
    str | None,
    value("URI", "Encoder: serial:///dev/ttyACM0 or socket://HOST:PORT.", "--encoder", panel=RIG),
]
RigFile = Annotated[Path | None, value("TOML", "Description of the rig.", "--rig", panel=RIG)]
Held = Annotated[str | None, value("JOINT", "Held joint, by name or number.", panel=URDF)]
Base = Annotated[str | None, value("LINK", "Fixed link.", panel=URDF)]
Tip = Annotated[str | None, value("LINK", "Flange link.", panel=URDF)]


def check_range(option: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Check that the number of an option, where it is given, is in its range.

    Raises:
        InputError: The number is outside, or NaN.
    """
    if value is not None and not low <= value <= high:
        span = f"from {low:g} to {high:.15g}" if high < inf else f"of at least {low:g}"
        raise InputError(f"{option} is {value}{unit}; give a number {span}{unit}")


def only(context: typer.Context, mode: str, *allowed: str, hint: str = "") -> None:
    """Refuse options of the command line that a mode of a verb does not take.

    Args:
        context: Context of the verb.
        mode: Name of the mode in the message.
        allowed: Names of the parameters that the mode takes.
        hint: Advice of the message; by default to leave the options out.

    Raises:
        InputError: Another option or argument was given.
    """
    odd: list[str] = []
    for parameter in context.command.params:
        name = str(parameter.name)
        source = context.get_parameter_source(name)
        if name not in allowed and source is not None and source.name == "COMMANDLINE":
            negated = context.params[name] is False and parameter.secondary_opts
            option = (negated or parameter.opts)[0]
            odd.append(option if option.startswith("-") else name.upper())
    if odd:
        names = " and ".join((", ".join(odd[:-1]), odd[-1]) if len(odd) > 1 else odd)
        verb, what = ("do", "them") if len(odd) > 1 else ("does", "it")
        raise InputError(f"{names} {verb} not go with {mode}; {hint or f'leave {what} out'}")


def read_pendulum(path: Path | None) -> "Pendulum":
    """Return the pendulum of a file, or the one that ships with Equipoise.

    Raises:
        InputError: The file is no pendulum.
    """
    from equipoise.model.pendulum import Pendulum, shipped_pendulum

    if path is None:
        return shipped_pendulum()
    if path.suffix.lower() == ".csv":
        raise InputError(
            f"{path} is a recording, expected a pendulum; make one of it: "
            f"equipoise identify {shlex.quote(str(path))}"
        )
    return Pendulum.load(path)


def read_policy(
    policy: Path | None,
    pendulum: Path | None = None,
    arm: "str | Arm | None" = None,
    actuator: str | None = None,
    settings: Path | None = None,
) -> "TaskPolicy":
    """Return a policy, bound to its task: that of its training, or what is given or ships.

    Args:
        policy: File or name of a policy, as `equipoise.control.bound_policy.load_policy` takes it.
        pendulum: File of the pendulum.
        arm: Arm, or the value of `--arm`.
        actuator: Value of `--actuator`; the caller uses it for a table.
        settings: File of settings.

    Raises:
        InputError: There is no such policy, or it does not fit the task.
    """
    from equipoise.control.bound_policy import load_policy
    from equipoise.settings import resolve

    return load_policy(
        policy,
        pendulum=None if pendulum is None else read_pendulum(pendulum),
        arm=read_arm(arm) if isinstance(arm, str) else arm,
        actuator=read_actuator(actuator),
        settings=None if settings is None else resolve(file=settings),
    )


def read_actuator(name: str | None) -> "Actuator | None":
    """Return the actuator that `--actuator` names, or None without that option.

    Raises:
        InputError: The file is no actuator.
    """
    from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator

    if name is None:
        return None
    if name == "ideal":
        return IDEAL_ACTUATOR
    path = Path(name)
    if path.suffix.lower() == ".mcap":
        raise InputError(
            f"{path} is a run log, expected an actuator; make one of it: "
            f"equipoise identify {shlex.quote(name)}"
        )
    return Actuator.load(path)


def read_arm(
    name: str, held: str | None = None, base: str | None = None, tip: str | None = None
) -> "Arm":
    """Return the arm of `--arm`.

    Args:
        name: Registered name such as iiwa7, or the path of a URDF or of a rig.toml.
        held: Joint of the URDF that does not move.
        base: Fixed link of the URDF.
        tip: Link of the URDF that is the flange.

    Raises:
        InputError: There is no such arm, or the options do not fit it.
    """
    from equipoise.model.arms.resolve import resolve_arm

    joint = int(held) if held is not None and held.isdecimal() else held
    if Path(name).suffix.lower() == ".toml":
        if joint or base or tip:
            raise InputError(
                f"{name} describes the joints of its arm; leave out --held, --base and --tip"
            )
        from equipoise.rigs import read_rig

        return read_rig(Path(name)).described_arm
    return resolve_arm(name, held=joint, base=base, tip=tip)


def available_workers(workers: int | None) -> int:
    """Return the number of threads."""
    from equipoise.simulation import available_cores

    return available_cores() if workers is None else workers
