"""Description of a rig: arm, pendulum holder, encoder and their addresses.

`rig.toml` contains the description in mm and degrees; every field has a default, unknown fields are
refused::

    arm = "iiwa7"
    robot = "kst://172.31.1.147:30001"
    encoder = "serial:///dev/ttyACM0"
    counts_per_rev = 8192
    encoder_sign = -1
    pivot_mm = [-130, 0, 35]
"""

from functools import cached_property
from math import degrees, radians
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, ValidationError, field_validator

from equipoise.arm.arm import Arm
from equipoise.arm.urdf import SUFFIXES, read_arm
from equipoise.errors import ArmError, SettingsError
from equipoise.files import Name, Value, first_fault
from equipoise.model.worlds import PREFIX as TWIN
from equipoise.safety.rules import POSITION_MARGIN, TORQUE_FRACTION
from equipoise.settings import read_toml

Degrees = Annotated[float, Field(ge=-3600.0, le=3600.0)]
Millimetres = Annotated[float, Field(ge=-400.0, le=400.0)]
"""Place on a flange: a holder reaches 400 mm at most."""


class Load(NamedTuple):
    """Load on a flange."""

    mass: float
    """Mass [kg]."""
    centre: tuple[float, float, float]
    """Centre of mass in the flange frame [m]."""


class RigSettings(Value):
    """Contents of `rig.toml`."""

    arm: Name = "iiwa7"
    """Name of the arm, or path of its URDF (from the folder of this file)."""
    held: int | None = None
    """Joint of a URDF that is held at its angle in `home_deg`, or at zero; counted from one."""
    tip: Name | None = None
    """Link of a URDF that is the flange; by default its only end."""
    acceleration_deg: float | None = Field(default=None, ge=10.0, le=1e4)
    """Acceleration limit of every joint of a URDF [deg/s^2], which a URDF does not contain."""
    robot: Name | None = None
    """Default of --robot, e.g. kst://172.31.1.147:30001."""
    encoder: Name | None = None
    """Default of --encoder, e.g. serial:///dev/ttyACM0; a twin emulates this kind of encoder."""
    home_deg: tuple[Degrees, ...] | None = None
    """Posture at x = 0, all joints [deg], with the pendulum's spindle along base y; by default the
    arm's own. For a URDF a posture is searched, without regard to tables and walls."""
    pivot_mm: tuple[Millimetres, Millimetres, Millimetres] | None = None
    """Pivot of the pendulum in the flange frame [mm]; by default the arm's own. On an iiwa, x is
    minus the distance from the axis of A7, and z the height of a media flange: 0, 35 or 61."""
    load_kg: float | None = Field(default=None, ge=0.01, le=20.0)
    """Mass of pendulum and holder [kg], for a robot that needs it before a motion; by default its
    own number stays in force. On a KUKA it is a tool in Sunrise.Workbench."""
    load_mm: tuple[Millimetres, Millimetres, Millimetres] | None = None
    """Their centre of mass in the flange frame [mm]; by default half way to the pivot."""
    counts_per_rev: int = Field(default=8192, ge=64, le=2**24)
    """Encoder counts per revolution, after x4."""
    encoder_sign: Literal[1, -1] = 1
    """1 if counts grow with theta, the pendulum's angle from hanging, else -1."""
    position_margin_deg: float = Field(default=degrees(POSITION_MARGIN), ge=1.0, le=30.0)
    """Minimum distance of setpoints from the joints' position limits [deg]."""
    speed_fraction: float = Field(default=1.0, ge=0.01, le=1.0)
    """Maximum fraction of the joints' velocity limits [-]; a run stops before exceeding it."""
    torque_fraction: float = Field(default=TORQUE_FRACTION, ge=0.01, le=1.0)
    """Maximum change of an external torque from its value at home, as a fraction of the joint's
    torque limit [-]; a run stops beyond it."""

    @field_validator("encoder_sign", mode="before")
    @classmethod
    def _is_a_number(cls, sign: Any) -> Any:
        if isinstance(sign, bool):  # true equals 1
            raise ValueError(f"expected 1 or -1, got {sign}")
        return sign

    @property
    def load(self) -> Load | None:
        """Load on the flange; None if its mass is not given.

        Raises:
            ArmError: As of `described_arm`.
        """
        if self.load_kg is None:
            return None
        x, y, z = self.load_mm or (500.0 * x for x in self.described_arm.pivot)
        return Load(self.load_kg, (x / 1e3, y / 1e3, z / 1e3))

    @cached_property
    def described_arm(self) -> Arm:
        """Arm of the rig, with its home posture and the pendulum's pivot on its flange.

        Raises:
            ArmError: The arm is unknown, or home is outside the joints' limits.
        """
        limit, home, pivot = self.acceleration_deg, self.home_deg, self.pivot_mm
        return read_arm(
            self.arm,
            held=self.held,
            tip=self.tip,
            acceleration=None if limit is None else radians(limit),
            home=None if home is None else [radians(angle) for angle in home],
            pivot=None if pivot is None else (pivot[0] / 1e3, pivot[1] / 1e3, pivot[2] / 1e3),
        )


def read_rig(path: Path | None) -> RigSettings:
    """Read a `rig.toml`; return the defaults without a path.

    Raises:
        SettingsError: The file cannot be read, or a value is invalid.
    """
    if path is None:
        return RigSettings()
    tree = read_toml(path, "the rig")
    arm = tree.get("arm")
    if isinstance(arm, str) and Path(arm).suffix.lower() in SUFFIXES:
        tree["arm"] = str(path.parent / arm)
    try:
        rig = RigSettings.read(tree)
        _ = rig.described_arm
    except ValidationError as error:
        raise SettingsError(f"the rig {path}: {first_fault(error)}") from None
    except ArmError as error:
        raise SettingsError(f"the rig {path}: {error}") from None
    return rig


def world_of(robot: str) -> str | None:
    """Return the twin behind an address, in virtual time in this process; None for hardware.

    Example:
        >>> world_of("twin:nominal"), world_of("kst://twin:harsh"), world_of("kst://172.31.1.147")
        ('twin:nominal', 'twin:harsh', None)
    """
    name = robot.partition("://")[2] or robot
    return name if name.startswith(TWIN) else None
