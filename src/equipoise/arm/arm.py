"""Serial arms: geometry, limits and masses of joints and links.

Each joint frame is placed in the previous one as in a URDF: `xyz`, then the fixed-axis angles
`rpy`, then the rotation by q about `axis`. The first frame is placed in the base (z up), the flange
in the last. An arm of seven joints holds one at a fixed angle, which becomes part of the constants:
kernels see the six *free* joints only, so that J is 6x6 (Safeea & Neto, section 3.1).
"""

from collections.abc import Sequence
from math import hypot, isclose
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, Self, TypeVar

import numpy as np
from pydantic import Field, ValidationError, model_validator

from equipoise.arm.chain import FREE_JOINTS
from equipoise.arm.compiler import FRAME_SIZE, PARTS, load
from equipoise.arrays import Array
from equipoise.elementary import BATCH_SIZE
from equipoise.errors import ArmError
from equipoise.files import Name, Number, Value, first_fault, shortened, value_digest

T = TypeVar("T")

Length = Annotated[float, Field(ge=-100.0, le=100.0)]
"""Coordinate [m]; a larger one is in millimetres."""
Offset = tuple[Length, Length, Length]
"""Origin in another frame [m]."""
Vector3 = tuple[Number, Number, Number]
"""Direction, or roll, pitch and yaw [rad]."""
Limit = Annotated[float, Field(gt=0.0, le=1e12)]
"""Limit of a velocity, an acceleration or a torque, both ways."""
ROUNDING: Final = 1e-6
"""Relative rounding of published moments of inertia."""


class _Described(Value):
    """Value whose constructor raises `ArmError` with one sentence."""

    if not TYPE_CHECKING:  # type checkers derive the constructor from the fields

        def __init__(self, **fields: Any) -> None:
            """Check the fields.

            Raises:
                ArmError: A field has an impossible value.
            """
            try:
                super().__init__(**fields)
            except ValidationError as error:
                what = f"{type(self).__name__.lower()} {shortened(str(fields.get('name')))}"
                raise ArmError(f"{what}: {first_fault(error)}") from None


class Inertial(_Described):
    """Mass, centre of mass and inertia of a link, in the frame of the joint that moves it."""

    name: Name
    """Name of the link."""
    mass: float = Field(ge=0.0, le=1e12)
    """Mass [kg]; zero if unknown."""
    com: Offset
    """Centre of mass [m]."""
    inertia: tuple[Number, Number, Number, Number, Number, Number]
    """Inertia about the centre of mass: xx, xy, xz, yy, yz, zz [kg m^2]; zeros if unknown."""

    @classmethod
    def of(cls, name: str, mass: float, com: Array, inertia: Array) -> Self:
        """Return an inertial from a centre of mass [m] and a matrix [kg m^2], shape (3, 3)."""
        xx, xy, xz, _, yy, yz, _, _, zz = inertia.ravel().tolist()
        return cls(name=name, mass=mass, com=com.tolist(), inertia=(xx, xy, xz, yy, yz, zz))

    @property
    def matrix(self) -> Array:
        """Inertia about the centre of mass [kg m^2], shape (3, 3)."""
        xx, xy, xz, yy, yz, zz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    @property
    def possible(self) -> bool:
        """Whether mass and principal moments are those of a body, but for rounding."""
        low, middle, high = np.linalg.eigvalsh(self.matrix).tolist()
        return self.mass > 0.0 and low > 0.0 and high <= (low + middle) * (1.0 + ROUNDING)


class Joint(_Described):
    """Revolute joint: origin in the frame of the previous joint, axis and limits."""

    name: Name
    """Name of the joint."""
    xyz: Offset
    """Origin in the frame of the previous joint [m]."""
    rpy: Vector3 = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw about the fixed axes of the previous frame [rad]."""
    axis: Vector3 = (0.0, 0.0, 1.0)
    """Axis of rotation in its own frame."""
    lower: Number
    """Lower limit of the position [rad]."""
    upper: Number
    """Upper limit of the position [rad]."""
    velocity: Limit
    """Limit of the velocity [rad/s]."""
    acceleration: Limit
    """Limit of the acceleration [rad/s^2]."""
    torque: Limit
    """Limit of the torque [N m]."""
    link: Inertial | None = None
    """Mass and inertia of the link that it moves; only simulations of the dynamics need them."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        low, high = self.lower, self.upper
        if not low < high:
            raise ValueError(
                f"limits from {low:g} to {high:g} rad; the lower must be below the upper"
            )
        if not 1e-6 <= hypot(*self.axis) <= 1e6:
            x, y, z = self.axis
            raise ValueError(f"axis {x:g} {y:g} {z:g}; give a direction, best of length 1")
        return self


class Kinematics(NamedTuple):
    """Motion of the flange in one state of the arm, in base axes."""

    position: Array
    """Position in the base [m], shape (3,)."""
    rotation: Array
    """Rotation from flange to base, shape (3, 3)."""
    twist: Array
    """J dq: linear [m/s] and angular [rad/s], shape (6,)."""
    bias: Array
    """J_dot dq: linear [m/s^2] and angular [rad/s^2], shape (6,)."""
    jacobian: Array
    """J, linear rows first, shape (6, 6)."""


class Arm(_Described):
    """A serial arm with six free joints, its flange and the pendulum's pivot on it."""

    name: Annotated[str, Field(pattern=r"^[\w .-]{1,64}$")]
    """Name in messages and file headers: letters, digits, blank, `_`, `.` and `-`."""
    joints: tuple[Joint, ...]
    """Joints from the base to the flange."""
    held_joint: int | None = None
    """Number of the joint that does not move, counted from one."""
    held_angle: Number = 0.0
    """Angle of the held joint [rad]."""
    flange_xyz: Offset = (0.0, 0.0, 0.0)
    """Origin of the flange in the last joint's frame [m]."""
    flange_rpy: Vector3 = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the flange in the last joint's frame [rad]."""
    pivot: Offset = (0.0, 0.0, 0.0)
    """Pivot of the pendulum in the flange frame [m]."""
    home: tuple[Number, ...]
    """Posture at x = 0, all joints [rad]. The pendulum's spindle lies along base y there."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        n, held, names = len(self.joints), self.held_joint, [joint.name for joint in self.joints]
        check_free(names, held)
        if len({*names, "phi"}) <= n:
            raise ValueError(f"joint names repeat, or one is phi: {', '.join(names)}; rename it")
        if len(self.home) != n:
            raise ValueError(f"home has {len(self.home)} angles; give one for each of {n} joints")
        if held is not None and not isclose(self.home[held - 1], self.held_angle, abs_tol=1e-9):
            at, angle = self.home[held - 1], self.held_angle
            raise ValueError(
                f"home has joint {held} at {at:g} rad, but it is held at {angle:g} rad; give one"
            )
        for number, (joint, q) in enumerate(zip(self.joints, self.home, strict=True), start=1):
            if not joint.lower <= q <= joint.upper:
                raise ValueError(
                    f"home has joint {number} ({joint.name}) at {q:g} rad, its limits are "
                    f"{joint.lower:g} and {joint.upper:g} rad; give a posture within them"
                )
        return self

    def __hash__(self) -> int:
        """Hash by value: compiled arms are cached by it."""
        return hash(tuple(getattr(self, field) for field in type(self).model_fields))

    @property
    def digest(self) -> str:
        """SHA-256 of the parameters of the flange's motion: geometry, held joint and limits.

        Names, masses, home and pivot are left out. The flange keeps its orientation, so every pivot
        on it has the same motion; a policy records its home separately.
        """
        joints = tuple(joint.model_copy(update={"name": ""}) for joint in self.joints)
        shape = {"name": "", "joints": joints, "home": (), "pivot": (0.0, 0.0, 0.0)}
        unnamed = self.model_copy(update=shape)
        return value_digest(unnamed, exclude={"joints": {"__all__": {"link"}}})

    @property
    def free(self) -> tuple[int, ...]:
        """Indices of the joints that move, counted from zero."""
        return self.without_held(range(len(self.joints)))

    @property
    def free_joints(self) -> tuple[Joint, ...]:
        """Joints that move."""
        return self.without_held(self.joints)

    @property
    def home_free(self) -> Array:
        """Posture at x = 0, free joints [rad], shape (6,)."""
        return np.array(self.without_held(self.home))

    def without_held(self, q: Sequence[T]) -> tuple[T, ...]:
        """Return the entries of the free joints: all joints in, six out."""
        return tuple(entry for number, entry in enumerate(q, 1) if number != self.held_joint)

    def with_held(self, q: Sequence[float] | Array) -> Array:
        """Return a posture of all joints [rad] from that of the six free ones [rad]."""
        full = [float(angle) for angle in q]
        if self.held_joint is not None:
            full.insert(self.held_joint - 1, self.held_angle)
        return np.array(full)

    def kinematics(
        self, q: Sequence[float] | Array, dq: Sequence[float] | Array = (0.0,) * FREE_JOINTS
    ) -> Kinematics:
        """Return pose, twist, bias and Jacobian of the flange, from Python, uncompiled.

        Args:
            q: Free joints [rad], shape (6,).
            dq: Their velocities [rad/s], shape (6,); at rest by default.
        """
        q_block, dq_block, frame = (
            [0.0] * (rows * BATCH_SIZE) for rows in (FREE_JOINTS, FREE_JOINTS, FRAME_SIZE)
        )
        q_block[::BATCH_SIZE] = (float(angle) for angle in q)
        dq_block[::BATCH_SIZE] = (float(rate) for rate in dq)
        load(self)[0](q_block, dq_block, frame, 1)
        position, R, twist, bias, J = np.split(np.array(frame[::BATCH_SIZE]), PARTS[1:])
        return Kinematics(position, R.reshape(3, 3), twist, bias, J.reshape(6, FREE_JOINTS))

    def link_inertials(self) -> list[Inertial]:
        """Return the inertial of the link that each joint moves.

        Raises:
            ArmError: A mass or an inertia is unknown or impossible; the message names all of them.
        """
        links = [joint.link for joint in self.joints if joint.link and joint.link.possible]
        if len(links) < len(self.joints):
            faults = [j.name for j in self.joints if j.link is None or not j.link.possible]
            raise ArmError(
                f"a twin of {self.name} needs mass and inertia of every moving link, and those "
                f"behind the joints {', '.join(faults)} are missing or impossible (each principal "
                "moment must be positive and at most the sum of the other two); complete them"
            )
        return links


def check_free(names: Sequence[str], held: int | None) -> None:
    """Check the number of free joints of a chain.

    Args:
        names: Names of its joints.
        held: Joint that does not move, counted from one.

    Raises:
        ArmError: There are not six.
    """
    n, free = len(names), len(names) - (held is not None)
    if held is not None and not 1 <= held <= n:
        raise ArmError(f"held joint is {held}; give a number from 1 to {n}")
    if free != FREE_JOINTS:
        remedy = {6: "leave out held", 7: "hold one with held"}.get(n, "choose another tip or arm")
        chain = shortened(", ".join(names), 300)
        raise ArmError(f"{free} free joints, expected six; {remedy} ({chain})")
