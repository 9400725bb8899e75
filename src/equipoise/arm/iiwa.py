"""The KUKA LBR iiwa 7 R800 and iiwa 14 R820, the arms of the experiment.

Both are one chain with different lengths: seven joints whose axes alternate between along the link
and across it, with a spherical shoulder, elbow and wrist (modified Denavit-Hartenberg, all a = 0).
Speeds and torques are KUKA's. KUKA publishes no limits of the accelerations; 10 rad/s^2 is the
limit of MoveIt configurations of the iiwa.

The paper holds joint 3 (section 3.1); it names neither the iiwa nor the posture. Our home
(90, 30, 0, -70, 0, 80, 0) degrees holds the flange pointing down in front of the arm, so that x is
tangential: A1 does most of the motion and the arm is far from its limits on the whole track.
"Outward", away from the base, is base +y there and -x of the flange frame.

KUKA publishes no inertias either. Masses and inertias (`data/iiwa7-links.csv`) come from
`lbr_description` of the LBR stack (Apache-2.0). Its joint frames lie half-way along the links and
beside them, and are parallel to the base at zero. The base, link 0, does not move and is left out.
"""

from functools import partial
from math import radians
from typing import Final, Literal

import numpy as np

from equipoise.arm.arm import Arm, Inertial, Joint
from equipoise.arm.chain import rotation_from_rpy
from equipoise.errors import ArmError
from equipoise.files import quoted
from equipoise.jit import PACKAGE
from equipoise.paper import HELD_JOINT

ALPHA_DEG: Final = (0.0, -90.0, 90.0, 90.0, -90.0, -90.0, 90.0)
"""Twist from each joint's axis to the next [deg]."""
LIMIT_DEG: Final = (170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0)
"""Position limits, both ways [deg]."""
ACCELERATION: Final = 10.0
"""Acceleration limit of every joint [rad/s^2]."""
HOME_DEG: Final = (90.0, 30.0, 0.0, -70.0, 0.0, 80.0, 0.0)
"""Home posture [deg]."""
PIVOT_OUTWARD: Final = 0.13
"""Distance from the axis of A7 to the plane in which the pendulum turns [m]. The pendulum passes in
front of the wrist, a ball of less than 0.1 m."""

_MODELS: Final = {
    "iiwa7": (
        (0.34, 0.40, 0.40, 0.126),
        (98.0, 98.0, 100.0, 130.0, 140.0, 180.0, 180.0),
        (176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0),
    ),
    "iiwa14": (
        (0.36, 0.42, 0.40, 0.126),
        (85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0),
        (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),
    ),
}
"""Lengths from base to shoulder, elbow, wrist and flange [m], velocity limits [deg/s] and torque
limits [N m] of each size."""


def iiwa(size: Literal[7, 14, "iiwa7", "iiwa14"]) -> Arm:
    """Return an iiwa with joint 3 held straight and the pendulum beside its flange.

    CLIK regulates the bare flange, 0.126 m from the wrist: it keeps its orientation, so every point
    fixed to it moves alike. A media flange moves the pivot only, and needs no other policy.

    Args:
        size: 7 or 14, or the name.

    Raises:
        ArmError: The size is unknown.
    """
    name = f"iiwa{str(size).removeprefix('iiwa')}"
    if name not in _MODELS:
        raise ArmError(f"there is no iiwa {quoted(size)}; choose 7 or 14")
    (base, upper_arm, forearm, hand), speeds_deg, torques = _MODELS[name]
    # d runs along the joint's own axis, which is the twisted z of the frame before it.
    along_y = (0.0, 0.0, -upper_arm, 0.0, forearm, 0.0, 0.0)
    links = np.loadtxt(PACKAGE / "data" / f"{name}-links.csv", delimiter=",").tolist()
    rows = zip(along_y, ALPHA_DEG, LIMIT_DEG, speeds_deg, torques, links, strict=True)
    joints: list[Joint] = []
    # Both frames of a link are fixed to it: their places at zero give one in the other.
    origin, rotation, published = np.zeros(3), np.eye(3), np.zeros(3)
    for number, (y, alpha, limit, speed, torque, link) in enumerate(rows, start=1):
        xyz, rpy = (0.0, y, base if number == 1 else 0.0), (radians(alpha), 0.0, 0.0)
        place, mass, com, moments = link[:3], link[3], link[4:7], link[7:]
        described = Inertial(name=f"link {number}", mass=mass, com=com, inertia=moments)
        origin = origin + rotation @ xyz
        rotation = rotation @ rotation_from_rpy(rpy)
        published = published + place
        inertia = rotation.T @ described.matrix @ rotation
        centre = rotation.T @ (published + com - origin)
        joint = Joint(
            name=f"A{number}",
            xyz=xyz,
            rpy=rpy,
            lower=-radians(limit),
            upper=radians(limit),
            velocity=radians(speed),
            acceleration=ACCELERATION,
            torque=torque,
            link=Inertial.of(described.name, mass, centre, inertia),
        )
        joints.append(joint)
    return Arm(
        name=name,
        joints=tuple(joints),
        held_joint=HELD_JOINT,
        flange_xyz=(0.0, 0.0, hand),
        pivot=(-PIVOT_OUTWARD, 0.0, 0.0),
        home=tuple(radians(angle) for angle in HOME_DEG),
    )


iiwa7, iiwa14 = partial(iiwa, 7), partial(iiwa, 14)
"""The arms as entry points of their names."""
