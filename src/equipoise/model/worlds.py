"""Simulated worlds for testing a policy, by name.

`ideal` is the paper's plant, whose arm has no delay; `model` is the training plant, with the
identified actuator. `twin:nominal` and others of `WORLDS` are named, frozen parameter sets of the
digital twin; `twin:FILE` is a TOML file of differences to nominal. A package registers a further
set, such a mapping of differences, under the entry point group `equipoise.twins`.

A twin's pendulum has the identified friction: viscous, dry and drag. A world may override dry
friction and drag: `pendulum_on`.

Each docstring gives the source of its number. The source of the KUKA Sunrise Toolbox and the arm's
data are facts; numbers marked *assumed* are pessimistic choices within the plausible range.
"""

import os.path
from collections.abc import Mapping
from difflib import get_close_matches
from math import log, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from pydantic import Field, ValidationError

from equipoise.entry_points import how_to_install, registered
from equipoise.errors import SettingsError
from equipoise.files import Value, first_fault, quoted
from equipoise.settings import MAX_COUNTS_PER_REV, QUARTER_TURN, read_toml

if TYPE_CHECKING:
    from equipoise.model.pendulum import Pendulum, PendulumParameters

IDEAL: Final = "ideal"
"""Name of the paper's plant in `--world` and in files."""
MODEL: Final = "model"
"""Name of the training plant in `--world` and in files."""
PREFIX: Final = "twin:"
"""Prefix of the names of digital twins."""

RotorInertia = Annotated[float, Field(ge=0.0, le=100.0)]
"""Inertia of the motor and gear of a joint, reflected to its output: n^2 J [kg m^2]."""
LWR_ROTORS: Final = (3.19, 3.05, 1.98, 2.05, 0.787, 0.391, 0.394)
"""Reflected rotor inertias of the KUKA LWR, A1 to A7 [kg m^2], the predecessor of the iiwa. Jubien,
Gautier and Janot identified them on that arm from motor and joint torques (IFAC Proceedings 47(3),
2014, pp. 8391-8396)."""


class TwinSettings(Value):
    """Parameters of the digital twin; the defaults are `nominal`."""

    transport: float = Field(default=0.010, ge=0.0, le=0.2)
    """Delay from sending a setpoint to its use by the servo [s]. Assumed: a request and its reply
    through Java take 3 to 4 ms at the rates that the toolbox's author reports; the rest is
    margin."""
    transport_jitter: float = Field(default=0.001, ge=0.0, le=0.05)
    """Half width of the uniform jitter of that delay [s]; the order is kept. Assumed."""
    cycle: float = Field(default=0.001, ge=0.001, le=0.01, multiple_of=0.001)
    """Cycle of a KST server's shaping law, in whole milliseconds [s]: `Thread.sleep(1)` in its
    source."""
    shaped: bool = True
    """Whether a KST server applies its shaping law, as in its source. Otherwise the destination is
    the setpoint, as behind KUKA's FRI."""
    reach_time: float | None = Field(default=None, ge=0.001, le=0.1)
    """Time in which the velocity of the drives would reach the destination [s]; by default the
    cycle. The servo of KUKA behind its shaping law is not published."""
    lag: float = Field(default=0.008, ge=0.001, le=0.1)
    """Time constant of the joint drives [s]. Assumed: 4 to 16 ms are plausible."""
    rotor_inertia: Annotated[tuple[RotorInertia, ...], Field(min_length=1)] = LWR_ROTORS
    """Inertia of motor and gear, reflected to the output of the joint [kg m^2]: one number for each
    joint from the base on, the last one for further joints. The drive knows it.
    KUKA publishes none for the iiwa. Default: as identified on its predecessor, the LWR. Drake's
    model of the iiwa 14 estimates more, from types of motors and gears: 3.4 for A1 to A4, 1.3 for
    A5, 1.2 for A6 and A7."""
    bracket_mass: float = Field(default=0.1, ge=0.0, le=14.0)
    """Mass of the bracket of the pendulum, unknown to the drive [kg]. Assumed. The payload of every
    iiwa is at most 14 kg."""
    pendulum_mass: float = Field(default=0.15, ge=1e-9, le=14.0)
    """Mass of the pendulum, unknown to the drive [kg]; modelled as a uniform rod. Assumed."""
    pivot_outward: float = Field(default=0.13, ge=0.0, le=1.0)
    """Distance from the axis of A7 to the pendulum's plane [m]: clearance for the wrist."""
    coulomb: float | None = Field(default=None, ge=0.0, le=1e3)
    """Override of the pendulum's dry friction over inertia [1/s^2]; None keeps the identified
    value."""
    drag: float | None = Field(default=None, ge=0.0, le=1e3)
    """Override of the pendulum's quadratic drag over inertia [1/rad]; None keeps the identified
    value."""
    assumed_coulomb: float = Field(default=0.1, ge=0.0, le=1e3)
    """Dry friction over inertia of a pendulum without an identified value [1/s^2], if `coulomb` is
    None. Assumed: recorded pivots show 0.05 to 2."""
    inertia_sigma: float = Field(default=0.02, ge=0.0, lt=0.25)
    """Standard deviation of the factor on I, drawn per trial."""
    friction_sigma: float = Field(default=0.2, ge=0.0, lt=1.0)
    """Standard deviation of the factor on b, drawn per trial."""
    counts_per_rev: int = Field(default=8192, ge=64, le=MAX_COUNTS_PER_REV)
    """Encoder counts per revolution, after x4: 2048 lines."""
    zero_error: float = Field(default=radians(0.2), ge=0.0, le=QUARTER_TURN)
    """Half width of the uniform zero error of the encoder, drawn per trial [rad]. Assumed: stiction
    leaves a hanging pendulum coulomb / w2 beside the vertical, 0.1 deg on a recorded arm."""
    zero_offset: float = Field(default=0.0, ge=-QUARTER_TURN, le=QUARTER_TURN)
    """Constant part of the zero error [rad]."""
    encoder_age: float = Field(default=0.001, ge=0.0, le=0.05)
    """Age of the newest count at a tick [s]: an encoder board sends at 1 kHz."""
    encoder_jitter: float = Field(default=0.0003, ge=0.0, le=0.01)
    """Half width of the uniform error of a count's time stamp [s]. Assumed: USB frames."""
    reply_age: float = Field(default=0.005, ge=0.0, le=0.1)
    """Age of the newest measured q at a tick [s]: the reply to the previous setpoint. Assumed."""
    joint_noise: float = Field(default=5e-5, ge=0.0, le=0.1)
    """Standard deviation of the noise on a measured joint position [rad]. Assumed: half of the
    arm's repeatability of 0.1 mm at 0.8 m, 6e-5 rad."""
    guards: bool = True
    """Whether the safety rules of a rig end a trial (cause `guard`)."""
    max_speed: float | None = Field(default=None, gt=0.0, le=2.0)
    """Flange speed limit of these rules [m/s]; None for none."""


def pendulum_on(
    pendulum: "Pendulum", settings: TwinSettings, varied: "PendulumParameters | None" = None
) -> "PendulumParameters":
    """Return the parameters of a pendulum with its effective friction in a twin.

    Args:
        pendulum: The pendulum, with the sources of its numbers.
        settings: Parameters of the twin, which may override dry friction and drag.
        varied: Parameters of the pendulum in one trial; by default its best values.
    """
    swings = pendulum.parameters() if varied is None else varied
    if settings.coulomb is not None:
        swings = swings._replace(coulomb=settings.coulomb)
    elif pendulum.coulomb.source == "assumed":
        swings = swings._replace(coulomb=settings.assumed_coulomb)
    return swings if settings.drag is None else swings._replace(drag=settings.drag)


def rotor_inertias(settings: TwinSettings, n: int) -> tuple[float, ...]:
    """Return the rotor inertia of each joint [kg m^2].

    Args:
        settings: Parameters of the twin.
        n: Number of joints of the arm.

    Example:
        >>> rotor_inertias(TwinSettings(rotor_inertia=(3.0, 2.0)), 3)
        (3.0, 2.0, 2.0)
    """
    rotors = settings.rotor_inertia
    return rotors[:n] + rotors[-1:] * (n - len(rotors))


class World(NamedTuple):
    """Digital twin with the name of its parameter set."""

    name: str
    """Name as given to `--world`, e.g. `twin:nominal`."""
    settings: TwinSettings
    """Parameters of the twin."""


POSITION_DRIVES: Final = {"reach_time": 0.016, "lag": -1e-3 / log(0.75)}
"""Drives that control the position, critically damped at omega = 125 rad/s: they reach the
destination in 2 / omega, and (1 - exp(-h / lag)) / h = 2 omega, with h = 1 ms."""
WORLDS: Final[Mapping[str, Mapping[str, Any]]] = {
    "nominal": {},
    "harsh": {
        "transport": 0.030,
        "counts_per_rev": 4096,
        "assumed_coulomb": 0.3,
        "zero_error": radians(0.4),
        "inertia_sigma": 0.04,
        "friction_sigma": 0.4,
    },
    # [kg m^2]: a fifth of a small motor (1e-5 kg m^2) behind 1:100.
    "light-rotors": {"rotor_inertia": (0.02,)},
    "bare": {"rotor_inertia": (0.0,)},
    "pd": POSITION_DRIVES,
    # `setMinimumTrajectoryExecutionTime` of a KST server.
    "trajectory40": {"reach_time": 0.040},
    "smart60": {"shaped": False, "transport": 0.044, **POSITION_DRIVES},
    "fri": {"shaped": False, "transport": 0.003, **POSITION_DRIVES},
}
"""Frozen parameter sets of the digital twin by name: differences to the defaults of `TwinSettings`.
What is known and what is guessed about each stands in docs/how-to/digital-twin.md."""


EFFECTS: Final[Mapping[str, Mapping[str, float]]] = {
    "transport delay": {"transport": 0.0},
    "transport jitter": {"transport_jitter": 0.0},
    "servo's shaping law": {"shaped": False},
    "drive lag": {"lag": 0.001},
    "encoder counts and age": {"counts_per_rev": 2**20, "encoder_age": 0.0, "encoder_jitter": 0.0},
    "zero error": {"zero_error": 0.0, "zero_offset": 0.0},
    "dry friction": {"coulomb": 0.0},
    "wrong I and b": {"inertia_sigma": 0.0, "friction_sigma": 0.0},
    "weight on the arm": {"bracket_mass": 0.0, "pendulum_mass": 0.01},
    "age of measured joints": {"reply_age": 0.0, "joint_noise": 0.0},
}
"""Numbers of the twin that belong to each effect, with the values that switch it off."""
CLEAN: Final[Mapping[str, float]] = {
    number: value for numbers in EFFECTS.values() for number, value in numbers.items()
}
"""Numbers of the clean twin, which has none of these effects."""


def named_twins() -> list[str]:
    """Return the names of all twins, without their prefix: of `WORLDS`, and of packages."""
    return [*WORLDS, *registered("equipoise.twins")]


def suggest_world(name: str) -> str:
    """Return the remedy for an unknown world: a similar name, or a package; empty without any.

    Example:
        >>> suggest_world("nominal"), suggest_world("twin:hrsh"), suggest_world("plant")
        ('did you mean twin:nominal?', 'did you mean twin:harsh?', '')
    """
    if install := how_to_install(name.removeprefix(PREFIX)):
        return install
    close = get_close_matches(name.removeprefix(PREFIX), named_twins(), n=1)
    return f"did you mean {PREFIX}{close[0]}?" if close else ""


def read_world(name: str) -> World:
    """Return the twin of a name.

    Args:
        name: `twin:` and one of `named_twins` (`twin:harsh`), or `twin:FILE`, where the file is
            TOML with differences to nominal.

    Raises:
        SettingsError: The world does not exist, or its file is invalid.

    Example:
        >>> world = read_world("twin:harsh")
        >>> world.name, world.settings.transport
        ('twin:harsh', 0.03)
    """
    name = str(name)
    which = name.removeprefix(PREFIX)
    if name.startswith(PREFIX):
        if which in WORLDS:
            return World(name, TwinSettings.model_validate(WORLDS[which]))
        if point := registered("equipoise.twins").get(which):
            return World(name, TwinSettings.model_validate(point.load()))
    file = Path(which)
    if not name.startswith(PREFIX) or not which or not os.path.lexists(file):
        twins = f"{', '.join(PREFIX + twin for twin in named_twins())} or {PREFIX}FILE.toml"
        remedy = suggest_world(name) or f"choose {twins}"
        raise SettingsError(f"there is no twin, and no such file, {quoted(name)}; {remedy}")
    try:
        which.encode()
    except UnicodeEncodeError:  # results name their world
        raise SettingsError(
            f"the name of the world {quoted(name)} is not UTF-8; give the file another name"
        ) from None
    differences = read_toml(file, "the numbers of a world")
    try:
        return World(name, TwinSettings.read(differences))
    except ValidationError as error:
        raise SettingsError(f"world {file}: {first_fault(error)}") from None
