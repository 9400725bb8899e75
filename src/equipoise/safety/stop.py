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

from equipoise.control.minimum_jerk import Path, path_within
from equipoise.errors import InputError
from equipoise.safety.rules import STOP_DECELERATION, Limits

Numbers = tuple[float, ...]

RETURN_SHARE: Final = 0.1
"""Share of the joints' velocity and acceleration limits on the way to the measured joints [-], as
on the way home."""
ROUNDING_RESERVE: Final = 1e-9
"""Share of the distance to a position limit that a ramp leaves for rounding [-]."""


class Ramp(NamedTuple):
    """Ramp to rest."""

    q0: Numbers
    """Joints at its start [rad]."""
    dq0: Numbers
    """Their velocities there [rad/s]."""
    rates: Numbers
    """Rate r of each joint [1/s]; inf at rest."""

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return 1.0 / min(self.rates)

    def at(self, time: float) -> Numbers:
        """Return the joints at a time since its start [rad]; the last ones after its end."""
        return tuple(
            q + dq * _sigma(rate, time)
            for q, dq, rate in zip(self.q0, self.dq0, self.rates, strict=True)
        )

    def speed_at(self, time: float) -> Numbers:
        """Return the velocities at a time since its start [rad/s]."""
        if time <= 0.0:
            return self.dq0
        return tuple(
            max(1.0 - rate * time, 0.0) * dq for dq, rate in zip(self.dq0, self.rates, strict=True)
        )


def at_rest(q: Sequence[float]) -> Ramp:
    """Return the ramp of joints at rest."""
    return Ramp(tuple(q), (0.0,) * len(q), (inf,) * len(q))


def _sigma(rate: float, time: float) -> float:
    t = min(max(time, 0.0), 1.0 / rate)
    return t * (1.0 - 0.5 * rate * t) if t > 0.0 else 0.0


def stoppable_speeds(
    dq: Sequence[float], last: Sequence[float], before: Sequence[float], dt: float
) -> Numbers:
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
        InputError: A value is not finite, or their number is not n.
    """
    for name, values in (("q", q), ("dq", dq), ("flange_speed", (flange_speed,) * limits.joints)):
        if len(values) != limits.joints or not all(isfinite(value) for value in values):
            raise InputError(
                f"{name} is {tuple(values)}, expected {limits.joints} finite numbers; "
                "stop from the last setpoint that was sent"
            )
    moving = [i for i, velocity in enumerate(dq) if velocity != 0.0]
    if not moving:
        return at_rest(q)
    # The joints' accelerations bound r from above; flange and position limits from below.
    most = {i: limits.acceleration[i] / abs(dq[i]) for i in moving}
    least: dict[int, float] = {}
    for i in moving:
        left = limits.upper[i] - q[i] if dq[i] > 0.0 else q[i] - limits.lower[i]
        least[i] = 0.5 * abs(dq[i]) / (left * (1.0 - ROUNDING_RESERVE)) if left > 0.0 else inf
    together = min(most.values())
    if flange_speed != 0.0:
        together = min(together, max(STOP_DECELERATION / abs(flange_speed), *least.values()))
    rates = [inf] * limits.joints
    for i in moving:
        rates[i] = min(max(together, least[i]), most[i])
    return Ramp(tuple(q), tuple(dq), tuple(rates))


class StopMotion:
    """Motion after a latched stop: the ramp, rest, and at most one way back."""

    def __init__(
        self, q: Sequence[float], dq: Sequence[float], flange_speed: float, limits: Limits
    ) -> None:
        """Begin the ramp; arguments as of `ramp`."""
        self._limits, self._ramp = limits, ramp(q, dq, flange_speed, limits)
        self._begin, self._end = tuple(q), self._ramp.at(inf)
        self._back: Path | None = None
        self._time = 0.0  # since the begin of the present motion
        self.q: Numbers = tuple(q)
        """Commanded joints [rad]."""
        self.dq: Numbers = tuple(dq)
        """Their velocities [rad/s]."""

    @property
    def at_rest(self) -> bool:
        """Whether the present motion has ended."""
        return self._time >= self._duration

    @property
    def rested(self) -> float:
        """Time at rest [s]; negative while the arm moves."""
        return self._time - self._duration

    @property
    def goes_back(self) -> bool:
        """Whether the arm is on its way back."""
        return self._back is not None and not self.at_rest

    @property
    def _duration(self) -> float:
        return self._ramp.duration if self._back is None else self._back.duration

    def advance(self, h: float) -> tuple[Numbers, Numbers]:
        """Return the setpoints in the middle and at the end of the next tick [rad].

        Args:
            h: Time between ticks [s].
        """
        half, self._time = self._time + 0.5 * h, self._time + h
        if self._back is not None:
            first, second = self._back.at(half), self._back.at(self._time)
            self.q, self.dq = second.q, second.dq
            return first.q, second.q
        self.q, self.dq = self._ramp.at(self._time), self._ramp.speed_at(self._time)
        return self._ramp.at(half), self.q

    def go_back(self, measured: Sequence[float]) -> float:
        """Begin the way back from rest; return the largest motion of a joint on it [rad].

        Args:
            measured: The measured joints [rad], shape (n,).
        """
        limits, end = self._limits, list[float]()
        for i, place in enumerate(measured):
            reach = abs(self._end[i] - self._begin[i])
            # A measured joint may be beyond a limit by its noise; a setpoint may not.
            low = max(self._begin[i] - reach, limits.lower[i])
            end.append(min(max(place, low), self._begin[i] + reach, limits.upper[i]))
        self._back = path_within(
            self.q,
            end,
            [RETURN_SHARE * limit for limit in limits.velocity],
            [RETURN_SHARE * limit for limit in limits.acceleration],
        )
        self._time = 0.0
        return max(abs(b - a) for a, b in zip(self.q, end, strict=True))

    def hold(self) -> None:
        """End the way back: brake the joints at their acceleration limits."""
        self._ramp, self._back, self._time = ramp(self.q, self.dq, 0.0, self._limits), None, 0.0

    def rest(self, q: Sequence[float]) -> None:
        """Go on from rest at a setpoint [rad], where the arm is after a stall of the stream."""
        self._ramp, self._back, self._time = at_rest(q), None, 0.0
        self.q, self.dq = self._ramp.q0, self._ramp.dq0
