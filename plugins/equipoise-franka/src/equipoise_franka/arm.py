"""The Franka Research 3 with joint 3 held, from the URDF beside this module.

Home (90, -20, 0, -130, 0, 110, 0) degrees holds the flange pointing down in front of the arm, so
that x is tangential: joint 1 does most of the motion, and the arm is far from its limits on the
whole track. "Outward", away from the base, is base +y there.
"""

from math import radians
from pathlib import Path
from typing import Final

from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_urdf

URDF: Final = Path(__file__).with_name("fr3.urdf")
"""The arm from its first link to its flange."""
HOME_DEG: Final = (90.0, -20.0, 0.0, -130.0, 0.0, 110.0, 0.0)
"""Home posture [deg]."""
ACCELERATION: Final = 10.0
"""Acceleration at which the controller stops the arm [rad/s^2]."""


def fr3() -> Arm:
    """Return the FR3, as the entry point of that name."""
    return read_urdf(
        URDF,
        held=3,
        home=[radians(angle) for angle in HOME_DEG],
        acceleration=ACCELERATION,
    )
