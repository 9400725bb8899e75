"""The KUKA LBR iiwa 7 R800 and iiwa 14 R820, the arms of the experiment.

Both are one chain with different lengths: seven joints whose axes alternate between along the link
and across it, with a spherical shoulder, elbow and wrist (modified Denavit-Hartenberg, all a = 0).
Speeds and torques are KUKA's. KUKA publishes no limits of the accelerations; 10 rad/s^2 is the
limit of MoveIt configurations of the iiwa.

The paper holds joint 3 (section 3.1); it names neither the iiwa nor the posture. Our home
(90, 30, 0, -70, 0, 80, 0) degrees holds the flange pointing down in front of the arm, so that x is
tangential: A1 does most of the motion and the arm is far from its limits on the whole track.
"Outward", away from the base, is base +y there and -x of the flange frame.

KUKA publishes no inertias either. Masses and inertias come from `lbr_description` of the LBR stack
(Apache-2.0). Its joint frames lie half-way along the links and beside them, and are parallel to the
base at zero. The base, link 0, does not move and is left out.
"""

from math import radians
from typing import Final, Literal

import numpy as np

from equipoise.arm import compiler
from equipoise.arm.arm import Arm, Inertial, Joint
from equipoise.arm.chain import rotation_from_rpy
from equipoise.errors import ArmError
from equipoise.files import quoted, write_atomically
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


# fmt: off
_LINKS: Final = {
    "iiwa7": (
        ((0.0, 0.0, 0.1475), 3.394011, (0.0, -0.034819, 0.123299),
         (0.021383, 0.0, 0.0, 0.020403, 0.003797, 0.007563)),
        ((0.0, -0.0105, 0.1925), 4.031991, (0.0, 0.039793, 0.086944),
         (0.031697, 0.0, 0.0, 0.03008, 0.005889, 0.009666)),
        ((0.0, 0.0105, 0.2075), 3.394011, (0.0, 0.034819, 0.123299),
         (0.021383, 0.0, 0.0, 0.020403, -0.003797, 0.007563)),
        ((0.0, 0.0105, 0.1925), 4.031989, (0.0, -0.039793, 0.086944),
         (0.031695, 0.0, 0.0, 0.030079, -0.005889, 0.009665)),
        ((0.0, -0.0105, 0.2075), 1.529239, (0.0, -0.029824, 0.076267),
         (0.008485, 0.0, 0.0, 0.007136, 0.002806, 0.003848)),
        ((0.0, -0.0707, 0.1925), 2.403626, (0.0, 0.07102, 0.00495),
         (0.007067, 0.0, 0.0, 0.006804, 0.000311, 0.004629)),
        ((0.0, 0.0707, 0.091), 0.259474, (3e-06, -2e-06, 0.013782),
         (0.000171, 0.0, 0.0, 0.000171, 0.0, 0.000299)),
    ),
    "iiwa14": (
        ((0.0, 0.0, 0.1475), 5.289529, (0.0, -0.033795, 0.132404),
         (0.042462, 0.0, 0.0, 0.042838, 0.006341, 0.01587)),
        ((0.0, -0.01, 0.2125), 5.688888, (0.000136, 0.047548, 0.076322),
         (0.055182, -3.3e-05, 5.6e-05, 0.053983, 0.010034, 0.016523)),
        ((0.0, 0.01, 0.228), 3.461245, (0.0, 0.034913, 0.123108),
         (0.02172, 0.0, 0.0, 0.02073, -0.003845, 0.007701)),
        ((0.0, 0.0105, 0.192), 4.122995, (0.0, -0.039793, 0.086944),
         (0.03241, 0.0, 0.0, 0.030758, -0.006022, 0.009883)),
        ((0.0, -0.0105, 0.2075), 1.563756, (0.0, -0.029824, 0.076267),
         (0.008677, 0.0, 0.0, 0.007297, 0.002869, 0.003935)),
        ((0.0, -0.0707, 0.1925), 2.457878, (0.0, 0.07102, 0.00495),
         (0.007227, 0.0, 0.0, 0.006958, 0.000318, 0.004734)),
        ((0.0, 0.0707, 0.091), 0.265331, (3e-06, -2e-06, 0.013782),
         (0.000175, 0.0, 0.0, 0.000175, 0.0, 0.000306)),
    ),
}
# fmt: on
"""For each joint its origin in the previous frame [m] (all axes are parallel at zero), and of the
link that it moves the mass [kg], the centre of mass [m], and xx, xy, xz, yy, yz, zz [kg m^2]."""


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
    rows = zip(along_y, ALPHA_DEG, LIMIT_DEG, speeds_deg, torques, _LINKS[name], strict=True)
    joints: list[Joint] = []
    # Both frames of a link are fixed to it: their places at zero give one in the other.
    origin, rotation, published = np.zeros(3), np.eye(3), np.zeros(3)
    for number, (y, alpha, limit, speed, torque, link) in enumerate(rows, start=1):
        xyz, rpy = (0.0, y, base if number == 1 else 0.0), (radians(alpha), 0.0, 0.0)
        place, mass, com, moments = link
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


def iiwa7() -> Arm:
    """Return the iiwa 7, as the entry point of that name."""
    return iiwa(7)


def iiwa14() -> Arm:
    """Return the iiwa 14, as the entry point of that name."""
    return iiwa(14)


def main() -> None:
    """Write the generated kinematics of both arms into the package."""
    for arm in (iiwa7(), iiwa14()):
        write_atomically(compiler.COMMITTED_FOLDER / f"{arm.name}.py", compiler.source(arm))


if __name__ == "__main__":
    main()
