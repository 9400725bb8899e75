r"""Joint velocities that lead an FR3 along a path, within the limits of its controller.

A path point :math:`q_k` and the measured joints :math:`q` give the velocity of the next
millisecond T,

.. math:: v = (q_k - q_{k-1}) / T + K (q_{k-3} - q)

since a stream of velocities alone drifts from its path. The velocity is then limited: first to an
acceleration with which the joint can still stay below its velocity limit, as in libfranka's
`limitRate`, and last to the jerk. The last velocity and acceleration are those that the controller
reports, so that a command after lost packets continues the motion that it has extrapolated.

Limits are those of libfranka's `rate_limiting.h` and of the FR3's URDF, whichever is lower.
"""

from typing import Final
from xml.etree import ElementTree

import numpy as np

from equipoise.rig.interfaces import Array
from equipoise.robots.franka.arm import ACCELERATION, URDF

PERIOD: Final = 0.001
"""Cycle of the controller [s]."""
LAG: Final = 3
"""Number of cycles by which the measured joints follow the path: one of the packets, and two of the
servo."""
GAIN: Final = 100.0
"""Share of the position error that a second of the correction removes, K [1/s]. Dry friction would
slow the joints by 2 to 4 mrad/s otherwise. Behind 5 ms of packets and servo the correction keeps a
phase margin of 60 deg."""
SHARE: Final = 0.95
"""Share of the controller's limits that is used [-]."""
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
