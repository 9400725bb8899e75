r"""Joint velocities that lead an FR3 along a path, within the limits of its controller.

A path point :math:`q_k` gives the velocity of the next millisecond T,

.. math:: v = (q_k - q_{k-1}) / T + K (q_{k-1} - q_d)

with the joints :math:`q_d` to which the controller has integrated the velocities, and which its
servo holds. Limits and lost packets take them off the path. Measured joints are not fed back: where
they are wrong, the arm would leave its path without limit.

The velocity is limited: first to an acceleration with which the joint can still stay below its
velocity limit, as in libfranka's `limitRate`, and last to the jerk. The last velocity and
acceleration are those that the controller reports, so that a command after lost packets continues
the motion that it has extrapolated.

Limits are those of libfranka's `rate_limiting.h` and of the FR3's URDF, whichever is lower.
"""

from typing import Final
from xml.etree import ElementTree

import numpy as np

from equipoise.arrays import Array
from equipoise_franka.arm import ACCELERATION, URDF

PERIOD: Final = 0.001
"""Cycle of the controller [s]."""
GAIN: Final = 100.0
"""Rate at which the correction removes the distance from the path, K [1/s]. A change of velocity of
0.1 rad/s, which takes 11 ms, leaves 0.5 mrad."""
SHARE: Final = 0.95
"""Fraction of the controller's limits that is used [-]."""
JERK: Final = 5000.0
"""Jerk at which the controller stops the arm [rad/s^3]."""
LOWER, UPPER, VELOCITY = np.array(
    [
        [float(limit.attrib[name]) for name in ("lower", "upper", "velocity")]
        for limit in ElementTree.parse(URDF).iter("limit")
    ]
).T
"""Position limits [rad], and velocity limits far from them [rad/s]."""
OFFSET: Final = np.array([0.652, 0.25, 0.2005, 0.3542, 0.5738, 0.4885, 0.4592])
"""Reduction of the velocity limits near the position limits [rad/s]."""
DECELERATION: Final = np.array([6.0, 2.585, 3.5, 4.0, 8.0, 5.5, 8.0])
"""Decelerations with which the joints have to be able to stop before them [rad/s^2]. The URDF has
17 for joints 5 and 7, which is beyond the acceleration limit."""


def velocity_limits(q: Array) -> tuple[Array, Array]:
    """Return the lower and upper velocity limits at a posture [rad/s], each of shape (7,).

    Args:
        q: The joints [rad], shape (7,).
    """

    def limit(distance: Array) -> Array:
        stoppable = np.sqrt(2.0 * DECELERATION * np.maximum(distance, 0.0)) - OFFSET
        return SHARE * np.clip(stoppable, 0.0, VELOCITY)

    return -limit(q - LOWER), limit(UPPER - q)


def limited(v: Array, last: Array, acceleration: Array, bounds: tuple[Array, Array]) -> Array:
    """Return the velocity of the next cycle [rad/s], shape (7,).

    The jerk limit has precedence over the velocity limits.

    Args:
        v: Desired velocity [rad/s], shape (7,).
        last: Last velocity [rad/s], shape (7,).
        acceleration: Last acceleration [rad/s^2], shape (7,).
        bounds: Lower and upper velocity limits [rad/s].
    """
    most, change = SHARE * ACCELERATION, SHARE * JERK * PERIOD
    lower, upper = ((bound - last) * JERK / ACCELERATION for bound in bounds)
    a = np.clip((v - last) / PERIOD, np.clip(lower, -most, most), np.clip(upper, -most, most))
    return last + PERIOD * np.clip(a, acceleration - change, acceleration + change)
