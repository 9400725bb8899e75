"""Options that several verbs share, and what they mean."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy
    from equipoise.model.actuator import Actuator
    from equipoise.model.arms.arm import Arm
    from equipoise.model.pendulum import Pendulum

LARGEST_SEED = 2**32 - 1

IN_AND_OUT = "Files and settings"
URDF = "For an arm from a URDF"
RECORDING = "The recording"
"""Titles of panels in the help."""

Json = Annotated[
    bool,
    typer.Option(
        "--json", help="Print one JSON object and nothing else.", rich_help_panel=IN_AND_OUT
    ),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Replace files that exist; else they are kept.",
        rich_help_panel=IN_AND_OUT,
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Go on with the interrupted training of this output, to the same result.",
        rich_help_panel=IN_AND_OUT,
    ),
]
SettingsFile = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        metavar="TOML",
        help="Settings, a table for each section.",
        rich_help_panel=IN_AND_OUT,
    ),
]
MaxSpeed = Annotated[
    float | None,
    typer.Option(
        metavar="M/S",
        help="A trial fails where the flange reaches this; in T1 0.23, by default nothing.",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="One setting; may be given again.",
        rich_help_panel=IN_AND_OUT,
    ),
]

Start = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Begin here; by default where the hand is seen to let go.",
        rich_help_panel=RECORDING,
    ),
]
End = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="End here.", rich_help_panel=RECORDING),
]
CountsPerRev = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Encoder counts per revolution, after x4.",
        rich_help_panel=RECORDING,
    ),
]
Columns = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help="Names of all columns in their order, e.g. time_s,theta_deg; for a file without a "
        "header, or with other names.",
        rich_help_panel=RECORDING,
    ),
]
FromUpright = Annotated[
    bool,
    typer.Option(
        "--from-upright",
        help="The recorded angle is zero when upright.",
        rich_help_panel=RECORDING,
    ),
]


def _seed(seed: int) -> int:
    if not 0 <= seed <= LARGEST_SEED:
        raise typer.BadParameter(f"{seed} is not from 0 to {LARGEST_SEED}.")
    return seed


Seed = Annotated[
    int,
    typer.Option(metavar="N", callback=_seed, help="Master seed; equal seeds give equal results."),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1, metavar="N", help="Threads; by default one per core. Results do not depend on it."
    ),
]
ArmName = Annotated[
    str,
    typer.Option(
        "--arm", metavar="ARM", help="iiwa7, iiwa14, another registered arm, a URDF or a rig.toml."
    ),
]
ActuatorFile = Annotated[
    str | None,
    typer.Option(
        "--actuator",
        metavar="FILE",
        help="From equipoise identify RUN.mcap, or ideal; by default the one that ships.",
    ),
]
KnownActuator = Annotated[
    str | None,
    typer.Option(
        "--actuator",
        metavar="FILE",
        help="What the controller knows of the arm; by default that of the policy.",
    ),
]
PolicyFile = Annotated[
    Path | None,
    typer.Argument(
        metavar="POLICY",
        help="From equipoise train; without it, the policy that ships.",
        show_default=False,
    ),
]
RunFile = Annotated[
    Path, typer.Argument(metavar="RUN", help="A log from deploy.", show_default=False)
]
Held = Annotated[
    str | None,
    typer.Option(
        metavar="JOINT", help="Joint that is held, by name or number.", rich_help_panel=URDF
    ),
]
Base = Annotated[
    str | None,
    typer.Option(metavar="LINK", help="Link that stands still.", rich_help_panel=URDF),
]
Tip = Annotated[
    str | None, typer.Option(metavar="LINK", help="Link that is the flange.", rich_help_panel=URDF)
]


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


def read_policy(path: Path | None) -> "TabularPolicy":
    """Return the policy of a file, or the one that ships with Equipoise.

    Raises:
        InputError: The file is no policy.
    """
    from equipoise.control.policy import TabularPolicy, shipped_policy

    return shipped_policy() if path is None else TabularPolicy.load(path)


def read_actuator(name: str | None) -> "Actuator | None":
    """Return the actuator that `--actuator` names; none where it is not given.

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
                f"{name} says which joints its arm has; leave --held, --base, --tip out"
            )
        from equipoise.rigs import read_rig

        return read_rig(Path(name)).described_arm
    return resolve_arm(name, held=joint, base=base, tip=tip)


def check_encoder() -> None:
    """Check before the work begins that a film can be encoded.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    from equipoise.report.pictures import find_encoder

    find_encoder()


def available_workers(workers: int | None) -> int:
    """Return how many threads to use."""
    from equipoise.learning.trials import available_cores

    return available_cores() if workers is None else workers
