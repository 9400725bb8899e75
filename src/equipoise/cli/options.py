"""Options that several verbs share, their checks, and the values that they name."""

import shlex
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.artefacts import Value
    from equipoise.control.policy import TaskPolicy
    from equipoise.executors import Executor
    from equipoise.model.actuator import Actuator
    from equipoise.model.arms.arm import Arm
    from equipoise.model.pendulum import Pendulum

V = TypeVar("V", bound="Value")

LARGEST_SEED = 2**32 - 1

IN_AND_OUT = "Files and settings"
URDF = "For an arm from a URDF"
RECORDING = "The recording"
RIG_PANEL = "The rig"
"""Titles of panels in the help."""


def value(
    metavar: str, help: str, *names: str, panel: str | None = None, default: Any = None, **more: Any
) -> Any:
    """Return the declaration of an option with a value.

    Args:
        metavar: Name of the value in the help.
        help: Text of the help.
        names: Names of the option; by default that of the parameter.
        panel: Title of its panel in the help.
        default: Default value; `...` for a required option.
        more: Further arguments of `typer.Option`.
    """
    return typer.Option(default, *names, metavar=metavar, help=help, rich_help_panel=panel, **more)


def flag(names: str, help: str, panel: str | None = None, *, default: bool = False) -> Any:
    """Return the declaration of an option without a value."""
    return typer.Option(default, names, help=help, rich_help_panel=panel, metavar="")


def argument(metavar: str, help: str, default: Any = ...) -> Any:
    """Return the declaration of an argument, required by default."""
    return typer.Argument(default, metavar=metavar, help=help, show_default=False)


def out(what: str, default: str | bool, metavar: str = "FILE") -> Any:
    """Return the declaration of `--out`, with its default name for the help."""
    return value(metavar, what, panel=IN_AND_OUT, show_default=default)


def _seed(seed: int) -> int:
    if not 0 <= seed <= LARGEST_SEED:
        raise typer.BadParameter(f"{seed} is not from 0 to {LARGEST_SEED}.")
    return seed


JSON = flag("--json", "Print one JSON object and nothing else.", IN_AND_OUT)
FORCE = flag("--force", "Replace existing files; otherwise they are kept.", IN_AND_OUT)
SETTINGS_FILE = value("TOML", "Settings, one table per section.", "--settings", panel=IN_AND_OUT)
SET = value("NAME=VALUE", "One setting; repeatable.", "--set", panel=IN_AND_OUT)
RECIPE = value(
    "NAME",
    "robust; fine: 756 boxes, for slow pendulums; paper: the most literal reading of its text.",
    default="robust",
)
MAX_SPEED = value("M/S", "Flange speed limit of a trial (T1: 0.23; default: none).")
TWIN = value("WORLD", "twin:nominal, twin:harsh, or twin:FILE.", default="twin:nominal")

START = value("SECONDS", "Begin here; by default at the detected release.", panel=RECORDING)
END = value("SECONDS", "End here.", panel=RECORDING)
COUNTS_PER_REV = value("N", "Encoder counts per revolution, after x4.", min=1, panel=RECORDING)
COLUMNS = value(
    "NAMES",
    "Names of all columns in order, e.g. time_s,theta_deg; for a file without a header, or with "
    "other names.",
    panel=RECORDING,
)
FROM_UPRIGHT = flag("--from-upright", "The recorded angle is zero when upright.", RECORDING)

SWING_OPTIONS = ("start", "end", "counts_per_rev", "from_upright", "columns")
"""Parameters of the options above."""

SEED = value("N", "Master seed; equal seeds give equal results.", default=0, callback=_seed)
WORKERS = value("N", "Threads, by default one per core; results do not depend on them.", min=1)
RAY = value("HOST:PORT", "Run on the Ray cluster with this head instead of in threads.")
ARM = value("ARM", "iiwa7, iiwa14, another registered arm, a URDF or a rig.toml.", default="iiwa7")
ACTUATORS = value(
    "FILE",
    "From equipoise identify RUN.mcap, or ideal; by default the shipped actuator. Repeatable: the "
    "first one is the controller's default.",
)
KNOWN_ACTUATOR = value(
    "FILE",
    "Actuator that the controller assumes; by default the policy's, of several the one that the "
    "move of the self-test shows.",
)
POLICY = argument(
    "POLICY",
    "Table from equipoise train, network (.onnx), Python MODULE:NAME, lqr, lqr-snapped, pd or "
    "random; by default the shipped table.",
    None,
)
TASK_PENDULUM = value("FILE", "Pendulum; by default the table's, or the shipped one.")
TASK_ARM = value("ARM", "Arm; by default the table's, the rig's, or iiwa7.")
RUN = argument("RUN", "Log from equipoise deploy.")
ROBOT = value("URI", "Robot: kst://HOST:30001.", panel=RIG_PANEL)
ENCODER = value("URI", "Encoder: serial:///dev/ttyACM0 or socket://HOST:PORT.", panel=RIG_PANEL)
RIG = value("TOML", "Description of the rig.", panel=RIG_PANEL)
HELD = value("JOINT", "Held joint, by name or number.", panel=URDF)
BASE = value("LINK", "Fixed link.", panel=URDF)
TIP = value("LINK", "Flange link.", panel=URDF)
LISTEN = value(
    "ADDRESS",
    "Listen on this address of the computer, for browsers on others; by default only browsers on "
    "this computer reach the page.",
    default="127.0.0.1",
)
PORT = value("N", "Port of the page; 0 selects a free one.", min=0, max=65535, default=0)


def check_range(option: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Check that the number of an option, where it is given, is in its range.

    Raises:
        InputError: The number is outside, or NaN.
    """
    if value is not None and not low <= value <= high:
        span = f"from {low:g} to {high:.15g}" if high < inf else f"of at least {low:g}"
        raise InputError(f"{option} is {value}{unit}; give a number {span}{unit}")


def swing_options(context: typer.Context) -> dict[str, Any]:
    """Return the options of a recording, as `read_swing` takes them."""
    return {name: context.params[name] for name in SWING_OPTIONS}


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


def changed(settings: V, **fields: object) -> V:
    """Return settings with the given fields changed; None keeps a field."""
    given = {name: value for name, value in fields.items() if value is not None}
    return settings.model_copy(update=given)


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


def shortfall(policy: "TaskPolicy") -> str:
    """Return one line where a policy misses the target of its training; else empty."""
    from equipoise.control.policy import TabularPolicy

    return policy.shortfall if isinstance(policy, TabularPolicy) else ""


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
        from equipoise.rig.config import read_rig

        return read_rig(Path(name)).described_arm
    return resolve_arm(name, held=joint, base=base, tip=tip)


def available_workers(workers: int | None) -> int:
    """Return the number of threads."""
    from equipoise.executors import available_cores

    return available_cores() if workers is None else workers


def executor(workers: int | None, ray: str | None) -> "Executor":
    """Return the executor of the tasks: threads, or a Ray cluster.

    Raises:
        InputError: Both are given, or the cluster has other versions.
        LinkError: No cluster answers.
        MissingExtraError: Ray is not installed.
    """
    if ray is None:
        from equipoise.executors import ThreadExecutor

        return ThreadExecutor(available_workers(workers))
    if workers is not None:
        raise InputError("both --workers and --ray are given; give one of them")
    from equipoise.cluster import RayExecutor

    return RayExecutor(ray)
