"""Excitation of an arm for identifying how it follows setpoints.

Each free joint moves about home along two sines under one Hann window, from rest to rest and up to
the joint's top speed. All frequencies differ, and are far from the pendulum's natural frequency, so
that the pendulum keeps hanging.

A servo with a shaping law answers a stream of 5 ms with bursts of twice the joint's mean speed,
which the load of the shoulder turns into torques. The top speeds keep the drives below their
limits; drives twice as fast as assumed reach one for 2 of the 10,000 ms.
"""

from typing import Final

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arrays import Array
from equipoise.errors import ArmError

PERIOD: Final = 0.005
"""Time between two setpoints [s]: half a control step."""
TOP_SPEED: Final = np.array([0.45, 0.3, 0.4, 1.0, 1.0, 1.0])
"""Top speed of each free joint, from the base on [rad/s]; the load falls towards the flange."""
FAST: Final = np.array([16.0, 14.5, 30.0, 12.0, 10.0, 11.0])
"""Angular frequency of the faster sine of each free joint [rad/s]. That of A4 tells the delay from
the time to the setpoint, whose effects differ with its cube."""
SLOW: Final = np.array([6.4, 5.8, 5.2, 4.8, 4.0, 4.4])
"""Angular frequency of the slower sine [rad/s]; the pendulum's own, 8.4 rad/s, lies between."""


def excitation(arm: Arm, duration: float = 10.0, period: float = PERIOD) -> Array:
    """Return setpoints around home that move every free joint, from rest to rest.

    Args:
        arm: The arm with its home posture.
        duration: Time from the first to the last setpoint [s].
        period: Time between two setpoints [s].

    Returns:
        Free joints [rad], shape (m, 6).

    Raises:
        ArmError: A joint's home is too close to its limits.
    """
    t = np.linspace(0.0, duration, round(duration / period) + 1)[:, None]
    order = np.arange(len(FAST))
    sines = np.sin(FAST * t + order) / FAST + np.sin(SLOW * t + 2 * order) / SLOW
    motion = np.sin(np.pi * t / duration) ** 2 * sines
    velocity = np.gradient(motion, period, axis=0)
    acceleration = np.gradient(velocity, period, axis=0)
    limits = np.array([(joint.velocity, joint.acceleration) for joint in arm.free_joints]).T
    limits *= 0.8  # margin
    most = np.minimum(TOP_SPEED, limits[0]) / np.abs(velocity).max(axis=0)
    motion *= np.minimum(most, limits[1] / np.abs(acceleration).max(axis=0))
    q = arm.home_free + motion
    for joint, lowest, highest in zip(arm.free_joints, q.min(axis=0), q.max(axis=0), strict=True):
        if not (joint.lower < lowest and highest < joint.upper):
            raise ArmError(
                f"excitation takes {joint.name} from {lowest:.3g} to {highest:.3g} rad, its limits "
                f"are {joint.lower:.3g} and {joint.upper:.3g} rad; choose a home further inside"
            )
    return q
