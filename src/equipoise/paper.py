"""Published numbers of the paper.

Safeea & Neto, "A Q-learning approach to the continuous control problem of robot inverted pendulum
balancing", Intelligent Systems with Applications. Each number carries its section. Units are those
of the paper (degrees for names that end in `_DEG`); the rest of the project converts them once.
Unpublished parameters are settings with a reason in `equipoise.settings`.
"""

from math import radians
from typing import Final


def inner_ends(intervals: tuple[str, ...]) -> tuple[float, ...]:
    """Return the lower ends of all intervals but the first.

    Example:
        >>> inner_ends(("]-0.22, -0.08]", "]-0.08, 0.08[", "[0.08, 0.22["))
        (-0.08, 0.08)
    """
    return tuple(float(interval[1:].partition(",")[0]) for interval in intervals[1:])


# Section 3.1: acceleration tracking.
HELD_JOINT: Final = 3
"""Index of the fixed redundant joint, from one."""

# Section 3.2: the pendulum.
FREE_SWING_PERIOD: Final = 0.75
"""Period of the free oscillation, "around 0.75 seconds" [s]."""

# Section 4.1: discretization.
ACTIONS: Final = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0)
"""Accelerations of the flange along x [m/s^2], without zero."""
U_MAX: Final = max(map(abs, ACTIONS))
"""Largest acceleration [m/s^2]."""

# Intervals as printed: ]a, b] is open at a and closed at b.
PHI_INTERVALS_DEG: Final = ("]-11, -5[", "[-5, -1[", "[-1, 0[", "[0, 1[", "[1, 5[", "[5, 11[")
"""Angle of the pendulum from upright [deg]."""

PHI_DOT_INTERVALS_DEG: Final = ("]-inf, -50]", "]-50, -10]", "]-10, 10[", "[10, 50[", "[50, inf[")
"""Angular velocity of the pendulum [deg/s]."""

X_INTERVALS: Final = ("]-0.22, -0.08]", "]-0.08, 0.08[", "[0.08, 0.22[")
"""Displacement of the flange along x [m]."""

X_DOT_INTERVALS: Final = ("]-inf, -0.5]", "]-0.5, 0.5[", "[0.5, inf[")
"""Velocity of the flange along x [m/s]."""

PHI_LIMIT_DEG: Final = 11.0
"""Failure angle |phi| [deg]."""

PHI_LIMIT: Final = radians(PHI_LIMIT_DEG)
"""Failure angle |phi| [rad]."""

X_LIMIT: Final = 0.22
"""Failure displacement |x| [m]."""

# Section 4.2: simulation.
EPISODES: Final = 10_000
"""Number of training episodes."""

STEP: Final = 0.01
"""Time step h [s]."""

# Section 4.3: the real robot.
SECONDS_BALANCED: Final = 5.0
"""Balancing time on the real robot [s]."""

X_AT_FAILURE: Final = -0.22
"""Displacement of the flange at the failure [m]."""

PHI_AT_FAILURE_DEG: Final = -3.44
"""Angle of the pendulum at the failure [deg]."""
