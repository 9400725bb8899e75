r"""Stop of a moving arm: a ramp inside the servo stream, and a way back within the ramp's reach.

From the commanded joints q0, with their velocities dq0, every joint slows down in proportion:

.. math:: q(t) = q_0 + \dot q_0\, \sigma(t), \qquad \sigma(t) = t - \tfrac12 r t^2, \qquad
          0 \le t \le 1/r

so that the arm keeps its direction of motion and is at rest at 1/r. The rate r makes the flange
decelerate at 4 m/s^2, or faster near a position limit, but no joint exceeds its acceleration limit.
With the flange at rest, the joints alone determine r. A joint that would still reach its position
limit, because another one cannot stop in time, stops before the others.

Where the arm is not at its setpoint, a minimum-jerk path may follow the ramp, from its end towards
the measured joints, so that the targets pull less at an arm that touches something or has been
braked. Measured joints may be wrong, and the drives may follow them: therefore no joint's target
goes further from the setpoint at the stop than the ramp did, whatever is measured.
"""

from collections.abc import Sequence
from math import inf, isfinite
from typing import Final, NamedTuple

from equipoise.control.minimum_jerk import MinimumJerk, Point, path_within
from equipoise.errors import InputError
from equipoise.safety.rules import STOP_DECELERATION, Limits

SLOW_FRACTION: Final = 0.1
"""Fraction of the joints' velocity and acceleration limits on the way home, and back towards the
measured joints [-]."""


class Ramp(NamedTuple):
    """Ramp to rest."""

    q0: tuple[float, ...]
    """Joints at its start [rad]."""
    dq0: tuple[float, ...]
    """Their velocities there [rad/s]."""
    rates: tuple[float, ...]
    """Rate r of each joint [1/s]; inf at rest."""

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return 1.0 / min(self.rates)

    def at(self, time: float) -> Point:
        """Return the joints [rad] and their velocities [rad/s] at a time since its start [s]."""
        q, dq = list(self.q0), list(self.dq0)
        for i, rate in enumerate(self.rates):
            t = min(max(time, 0.0), 1.0 / rate)
            if t > 0.0:
                q[i] += dq[i] * (t * (1.0 - 0.5 * rate * t))
            if time > 0.0:
                dq[i] *= max(1.0 - rate * time, 0.0)
        return Point(tuple(q), tuple(dq))


def stoppable_speeds(
    dq: Sequence[float], last: Sequence[float], before: Sequence[float], dt: float
) -> tuple[float, ...]:
    """Return the velocities at the start of a ramp [rad/s], shape (n,).

    The commanded velocities; for an accelerating joint the mean velocity to the last setpoint, from
    which it can be stopped by the safety rules.

    Args:
        dq: The commanded velocities at the last setpoint [rad/s], shape (n,).
        last: The setpoint sent last [rad], shape (n,).
        before: The one before that [rad], shape (n,).
        dt: Time between the two [s].
    """
    mean = [(b - a) / dt for a, b in zip(before, last, strict=True)]
    return tuple(v if abs(v) < abs(m) else m for v, m in zip(dq, mean, strict=True))


def ramp(q: Sequence[float], dq: Sequence[float], flange_speed: float, limits: Limits) -> Ramp:
    """Return the ramp to rest.

    Args:
        q: The last commanded joints [rad], shape (n,).
        dq: Their velocities [rad/s], shape (n,).
        flange_speed: Speed of the flange there [m/s].
        limits: Limits of the joints.

    Raises:
        InputError: A value is not finite.
    """
    if not all(map(isfinite, (*q, *dq, flange_speed))):
        raise InputError(
            f"a stop from {tuple(q)} rad with {tuple(dq)} rad/s and {flange_speed} m/s; expected "
            "finite numbers"
        )
    rates = [inf] * len(dq)
    moving = [i for i, velocity in enumerate(dq) if velocity != 0.0]
    # The joints' accelerations bound r from above; flange and position limits from below.
    most = {i: limits.acceleration[i] / abs(dq[i]) for i in moving}
    least: dict[int, float] = {}
    for i in moving:
        left = limits.upper[i] - q[i] if dq[i] > 0.0 else q[i] - limits.lower[i]
        # A billionth of the distance is left for rounding.
        least[i] = 0.5 * abs(dq[i]) / (left * (1.0 - 1e-9)) if left > 0.0 else inf
    together = min(most.values(), default=inf)
    if flange_speed != 0.0:
        slowest = max(STOP_DECELERATION / abs(flange_speed), *least.values(), 0.0)
        together = min(together, slowest)
    for i in moving:
        rates[i] = min(max(together, least[i]), most[i])
    return Ramp(tuple(q), tuple(dq), tuple(rates))


def way_back(
    stop: Ramp, q: Sequence[float], measured: Sequence[float], limits: Limits
) -> MinimumJerk:
    """Return the path from rest towards the measured joints, within the reach of a stop's ramp.

    Args:
        stop: The ramp.
        q: The joints at rest after it [rad], shape (n,).
        measured: The measured joints [rad], shape (n,).
        limits: Limits of the joints.
    """
    end: list[float] = []
    begin, rest = stop.q0, stop.at(inf).q
    for i, place in enumerate(measured):
        reach = abs(rest[i] - begin[i])
        # A measured joint may be beyond a limit by its noise; a setpoint may not.
        low = max(begin[i] - reach, limits.lower[i])
        end.append(min(max(place, low), begin[i] + reach, limits.upper[i]))
    return slow_path(q, end, limits)


def slow_path(q: Sequence[float], end: Sequence[float], limits: Limits) -> MinimumJerk:
    """Return a slow path between two postures [rad], shape (n,) each, within a tenth of limits."""
    velocity = [SLOW_FRACTION * limit for limit in limits.velocity]
    acceleration = [SLOW_FRACTION * limit for limit in limits.acceleration]
    return path_within(q, end, velocity, acceleration)
