"""A serial arm as numbers: where its joints are, how they are limited, which one is held.

Each joint frame is placed in the one before it as a URDF does: `xyz`, then the fixed-axis angles
`rpy`, then the turn by q about `axis`; the first in the base (z up), the flange in the last. Where
there are seven joints one is held at a fixed angle and becomes part of the constants: kernels see
the six *free* joints only, so that J is 6x6 (Safeea & Neto, section 3.1).

The compiled kinematics writes one record of `FRAME_SIZE` rows, all in base axes, for each lane of
a block (see `equipoise.model.elementary`)::

    POSITION  0:3    the flange [m]
    ROTATION  3:12   R, flange to base, row by row
    TWIST    12:18   J dq: linear [m/s], angular [rad/s]
    BIAS     18:24   J_dot dq [m/s^2], [rad/s^2]
    JACOBIAN 24:60   J, row by row, linear rows first
"""

import functools
from collections.abc import Callable, Sequence
from math import hypot, isclose
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, Self, TypeVar

import numba
import numpy as np
from pydantic import Field, ValidationError, model_validator

from equipoise.artefacts import Name, Value, first_fault, shortened, value_digest
from equipoise.compiled import function_pointer
from equipoise.errors import ArmError
from equipoise.model.arms.chain import Floats, Triple, wrist_centre
from equipoise.model.elementary import BATCH_SIZE

T = TypeVar("T")
KinematicsFunction = Callable[[Any, Any, Any, int], None]
"""Called as kinematics(q, dq, frame, lanes): reads the first two, writes the record of so many
lanes of the block."""

POSITION: Final = 0
ROTATION: Final = 3
TWIST: Final = 12
BIAS: Final = 18
JACOBIAN: Final = 24
FRAME_SIZE: Final = 60
FREE_JOINTS: Final = 6
MOST_JOINTS: Final = 64
"""Limit on the joints of a chain: only six or seven can be used, and a message names the rest."""

Angle = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Angle of a joint [rad]; no cable takes 160 turns."""
Angles = tuple[Angle, Angle, Angle]
"""Roll, pitch and yaw [rad]."""
Length = Annotated[float, Field(ge=-100.0, le=100.0)]
"""Coordinate [m]; no arm is 100 m long."""
Offset = tuple[Length, Length, Length]
"""Origin in another frame [m]."""
Limit = Annotated[float, Field(le=1e9)]
"""Limit of a velocity, an acceleration or a torque in SI units; larger ones limit nothing."""


class _Described(Value):
    """A value that says what is wrong with its description."""

    if not TYPE_CHECKING:  # for a reader of types the fields are the constructor

        def __init__(self, **fields: Any) -> None:
            """Check the fields.

            Raises:
                ArmError: The thing cannot be what the fields say.
            """
            try:
                super().__init__(**fields)
            except ValidationError as error:
                fault = first_fault(error)
                what = f"{type(self).__name__.lower()} {shortened(str(fields.get('name')))}"
                where = f"{fault.where}: " if fault.where else ""
                got = f", got {fault.got}" if fault.where else ""
                raise ArmError(f"{what}: {where}{fault.what}{got}") from None


class Joint(_Described):
    """A revolute joint: its place in the frame of the joint before it, its axis, its limits."""

    name: Name
    """What the maker calls it."""
    xyz: Offset
    """Origin in the frame of the joint before it [m]."""
    rpy: Angles = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw about the fixed axes of the frame before it [rad]."""
    axis: Triple = (0.0, 0.0, 1.0)
    """Axis of rotation in its own frame."""
    lower: Angle
    """Lower limit of the position [rad]."""
    upper: Angle
    """Upper limit of the position [rad]."""
    velocity: Limit
    """Limit of the velocity, both ways [rad/s]."""
    acceleration: Limit
    """Limit of the acceleration, both ways [rad/s^2]."""
    torque: Limit
    """Limit of the torque, both ways [N m]."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if not self.lower < self.upper:
            raise ValueError(
                f"limits from {self.lower:g} to {self.upper:g} rad; "
                "the lower must be below the upper"
            )
        for limit in ("velocity", "acceleration", "torque"):
            if not getattr(self, limit) > 0.0:
                raise ValueError(
                    f"{limit} limit of {getattr(self, limit):g}; give a positive number"
                )
        if not 1e-6 <= hypot(*self.axis) <= 1e6:
            x, y, z = self.axis
            raise ValueError(f"axis {x:g} {y:g} {z:g}; give a direction, best of length 1")
        return self


class Pose(NamedTuple):
    """Where the flange is."""

    position: Floats
    """In the base [m], shape (3,)."""
    rotation: Floats
    """Flange to base, shape (3, 3)."""


class Kinematics(NamedTuple):
    """The flange at one state of the arm, in base axes."""

    position: Floats
    """In the base [m], shape (3,)."""
    rotation: Floats
    """Flange to base, shape (3, 3)."""
    twist: Floats
    """J dq: linear [m/s] and angular [rad/s], shape (6,)."""
    bias: Floats
    """J_dot dq: linear [m/s^2] and angular [rad/s^2], shape (6,)."""
    jacobian: Floats
    """J, linear rows first, shape (6, 6)."""


class ArmKernel(NamedTuple):
    """What kernels take of an arm; a `NamedTuple` because they cannot take a model."""

    kinematics: KinematicsFunction
    """kinematics(q, dq, frame, lanes), compiled for blocks of 6, 6 and `FRAME_SIZE` rows."""
    wrist: Floats
    """Point where the last three axes meet, in the flange frame [m], shape (3,); NaN if none."""
    lower: Floats
    """Lower limits of the free joints [rad], shape (6,)."""
    upper: Floats
    """Upper limits of the free joints [rad], shape (6,)."""
    max_velocity: Floats
    """Limits of their velocities [rad/s], shape (6,)."""
    max_acceleration: Floats
    """Limits of their accelerations [rad/s^2], shape (6,)."""


class Arm(_Described):
    """A serial arm with six free joints, its flange and the pendulum's place on it."""

    name: Annotated[str, Field(pattern=r"^[\w .-]{1,64}$")]
    """What it is called in messages and file headers: letters, digits, blank, `_`, `.` and `-`."""
    joints: Annotated[tuple[Joint, ...], Field(max_length=MOST_JOINTS)]
    """From the base to the flange."""
    held_joint: int | None = None
    """The joint that does not move, counted from one."""
    held_angle: Angle = 0.0
    """Where it is held [rad]."""
    flange_xyz: Offset = (0.0, 0.0, 0.0)
    """Origin of the flange in the last joint's frame [m]."""
    flange_rpy: Angles = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the flange in the last joint's frame [rad]."""
    pivot: Offset = (0.0, 0.0, 0.0)
    """The pendulum's pivot in the flange frame [m]."""
    home: Annotated[tuple[Angle, ...], Field(max_length=MOST_JOINTS)]
    """Posture at x = 0, all joints [rad]. The pendulum's spindle lies along base y there."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        n, held = len(self.joints), self.held_joint
        if held is not None and not 1 <= held <= n:
            raise ValueError(f"held joint is {held}; give a number from 1 to {n}")
        free = n - (held is not None)
        if free != FREE_JOINTS:
            raise ValueError(f"{free} free joints, expected six; {_which_to_hold(self.joints)}")
        if len(self.home) != n:
            raise ValueError(f"home has {len(self.home)} angles; give one for each of {n} joints")
        if held is not None and not isclose(self.home[held - 1], self.held_angle, abs_tol=1e-9):
            raise ValueError(
                f"home has joint {held} at {self.home[held - 1]:g} rad, but it is held at "
                f"{self.held_angle:g} rad; give one angle"
            )
        for number, (joint, q) in enumerate(zip(self.joints, self.home, strict=True), start=1):
            if not joint.lower <= q <= joint.upper:
                raise ValueError(
                    f"home has joint {number} ({joint.name}) at {q:g} rad, its limits are "
                    f"{joint.lower:g} and {joint.upper:g} rad; give a posture within them"
                )
        return self

    def __hash__(self) -> int:
        """Frozen, hence hashable: compiled arms are kept by value."""
        return hash(tuple(getattr(self, field) for field in type(self).model_fields))

    @property
    def digest(self) -> str:
        """SHA-256 of all that decides how the flange moves: geometry, held joint, limits.

        Names, home and pivot are left out: the flange keeps its orientation, so that a pivot
        elsewhere on it moves in the same way, and a policy records its home by itself.
        """
        return _shape(self, limits=True)

    @property
    def geometry_digest(self) -> str:
        """SHA-256 of what the kinematics is generated from: the geometry and the held joint."""
        return _shape(self, limits=False)

    @property
    def free(self) -> tuple[int, ...]:
        """Places of the joints that move, counted from zero."""
        return self.without_held(range(len(self.joints)))

    @property
    def free_joints(self) -> tuple[Joint, ...]:
        """The joints that move."""
        return self.without_held(self.joints)

    @property
    def home_free(self) -> Floats:
        """Posture at x = 0, free joints [rad], shape (6,)."""
        return np.array(self.without_held(self.home))

    def without_held(self, q: Sequence[T]) -> tuple[T, ...]:
        """Return the entries of the free joints: all joints in, six out."""
        return tuple(entry for number, entry in enumerate(q, 1) if number != self.held_joint)

    def with_held(self, q: Sequence[float] | Floats) -> Floats:
        """Return a posture of all joints [rad] from that of the six free ones [rad]."""
        full = [float(angle) for angle in q]
        if self.held_joint is not None:
            full.insert(self.held_joint - 1, self.held_angle)
        return np.array(full)

    def kinematics(
        self, q: Sequence[float] | Floats, dq: Sequence[float] | Floats = (0.0,) * FREE_JOINTS
    ) -> Kinematics:
        """Return pose, twist, bias and Jacobian of the flange, from Python, uncompiled.

        Args:
            q: Free joints [rad], shape (6,).
            dq: Their velocities [rad/s], shape (6,).
        """
        from equipoise.model.arms.compiler import load

        q_block, dq_block, frame = (
            [0.0] * (rows * BATCH_SIZE) for rows in (FREE_JOINTS, FREE_JOINTS, FRAME_SIZE)
        )
        q_block[::BATCH_SIZE] = (float(angle) for angle in q)
        dq_block[::BATCH_SIZE] = (float(rate) for rate in dq)
        load(self)(q_block, dq_block, frame, 1)
        record = np.array(frame[::BATCH_SIZE])
        return Kinematics(
            position=record[POSITION:ROTATION],
            rotation=record[ROTATION:TWIST].reshape(3, 3),
            twist=record[TWIST:BIAS],
            bias=record[BIAS:JACOBIAN],
            jacobian=record[JACOBIAN:].reshape(6, FREE_JOINTS),
        )

    def pose(self, q: Sequence[float] | Floats) -> Pose:
        """Return where the flange is when the free joints are at `q` [rad], shape (6,)."""
        flange = self.kinematics(q)
        return Pose(flange.position, flange.rotation)

    def compiled(self) -> ArmKernel:
        """Return the arm as kernels take it; compiled, or found in the cache, on the first call."""
        return _compiled(self)


def _which_to_hold(joints: Sequence[Joint]) -> str:
    if len(joints) != FREE_JOINTS + 1:
        return "give an arm with six joints, or with seven of which one is held"
    names = ", ".join(f"{number} ({joint.name})" for number, joint in enumerate(joints, start=1))
    return f"hold one of {names}"


def _shape(arm: Arm, *, limits: bool) -> str:
    nameless: dict[str, Any] = {"name": ""}
    if not limits:
        nameless |= dict.fromkeys(("lower", "upper", "velocity", "acceleration", "torque"), 0.0)
    joints = tuple(joint.model_copy(update=nameless) for joint in arm.joints)
    elsewhere = {"name": "", "joints": joints, "home": (), "pivot": (0.0, 0.0, 0.0)}
    return value_digest(arm.model_copy(update=elsewhere))


@functools.cache
def _compiled(arm: Arm) -> ArmKernel:
    from equipoise.model.arms.compiler import load

    array = numba.float64[::1]
    limits = np.array([(j.lower, j.upper, j.velocity, j.acceleration) for j in arm.free_joints])
    lower, upper, velocity, acceleration = np.ascontiguousarray(limits.T)
    return ArmKernel(
        kinematics=function_pointer(load(arm), numba.void(array, array, array, numba.int64)),
        wrist=wrist_centre(arm),
        lower=lower,
        upper=upper,
        max_velocity=velocity,
        max_acceleration=acceleration,
    )
