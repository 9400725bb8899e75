r"""Minimum-jerk paths from rest to rest: polynomials of fifth order (Flash & Hogan 1985).

.. math:: s(\tau) = 10 \tau^3 - 15 \tau^4 + 6 \tau^5, \qquad \tau = t / T

Velocity and acceleration are zero at both ends; s stays within [0, 1]. All joints, or one position
on the track, move along a straight line together.
"""

from collections.abc import Sequence
from math import sqrt
from typing import Final, NamedTuple

PEAK_VELOCITY: Final = 1.875
"""Largest ds/dtau, in the middle: 15 / 8."""
PEAK_ACCELERATION: Final = 10.0 / sqrt(3.0)
"""Largest |d2s/dtau2|, at tau = 1/2 -+ sqrt(3)/6."""


class Point(NamedTuple):
    """State of a motion at a time."""

    q: tuple[float, ...]
    """Positions: joints [rad] or the track [m]."""
    dq: tuple[float, ...]
    """Their velocities [rad/s] or [m/s]."""


class MinimumJerk(NamedTuple):
    """A minimum-jerk path from rest to rest."""

    start: tuple[float, ...]
    """Positions at its start."""
    end: tuple[float, ...]
    """Positions at its end."""
    duration: float
    """Duration T [s]; zero without motion."""

    def at(self, time: float) -> Point:
        """Return the state at a time since the start [s]; at rest before and after the path."""
        if time <= 0.0 and self.duration > 0.0:
            return Point(self.start, (0.0,) * len(self.start))
        if time >= self.duration:
            return Point(self.end, (0.0,) * len(self.end))
        T = self.duration
        tau = time / T
        s = tau**3 * (10.0 - tau * (15.0 - 6.0 * tau))
        ds = 30.0 * (tau * (1.0 - tau)) ** 2 / T
        ways = [b - a for a, b in zip(self.start, self.end, strict=True)]
        q = tuple(a + s * way for a, way in zip(self.start, ways, strict=True))
        return Point(q, tuple(ds * way for way in ways))


def path_within(
    start: Sequence[float],
    end: Sequence[float],
    velocity: Sequence[float],
    acceleration: Sequence[float],
) -> MinimumJerk:
    """Return the quickest minimum-jerk path within limits.

    Args:
        start: Positions at its start, shape (n,).
        end: Positions at its end, shape (n,).
        velocity: Limits of the velocities, positive, shape (n,).
        acceleration: Limits of the accelerations, positive, shape (n,).
    """
    duration = 0.0
    for a, b, v, acc in zip(start, end, velocity, acceleration, strict=True):
        way = abs(b - a)
        duration = max(duration, PEAK_VELOCITY * way / v, sqrt(PEAK_ACCELERATION * way / acc))
    return MinimumJerk(tuple(start), tuple(end), duration)
