r"""The way to rest: a ramp inside the servo stream, and the way back to where the arm is.

From the commanded joints q0, with their velocities dq0, every joint slows down in proportion:

.. math:: q(t) = q_0 + \dot q_0\, \sigma(t), \qquad \sigma(t) = t - \tfrac12 r t^2, \qquad
          0 \le t \le 1/r

so that the arm goes on in the direction in which it moves, ever slower, and is at rest at 1/r. The
rate r is such that the flange slows down at 4 m/s^2, or sooner at rest where a position limit is
near, but no joint decelerates by more than its limit. A flange that does not move says nothing
about r: then the joints alone decide.

Where the arm was not where it was sent (`from_measured`), the ramp is followed by a minimum-jerk
path from its end to the measured joints: then nothing pulls at the arm, and no old target is left
for it to go to when its brakes open.
"""

from collections.abc import Sequence
from math import inf, isfinite
from typing import Final, NamedTuple

from equipoise.control.minimum_jerk import Path, path_within
from equipoise.control.safety import STOP_DECELERATION, Limits
from equipoise.errors import InputError

Numbers = tuple[float, ...]

RETURN_SHARE: Final = 0.1
"""Share of the joints' velocities and accelerations on the way to the measured joints: as slow as
the way home."""


class Ramp(NamedTuple):
    """A way to rest."""

    q0: Numbers
    """Where it begins [rad]."""
    dq0: Numbers
    """The velocities there [rad/s]."""
    rate: float
    """r [1/s]; inf where the arm is at rest."""

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return 1.0 / self.rate

    def at(self, time: float) -> Numbers:
        """Return the joints at a time since its begin [rad]; the last ones for ever after."""
        t = min(max(time, 0.0), self.duration)
        sigma = t * (1.0 - 0.5 * self.rate * t) if t > 0.0 else 0.0
        return tuple(q + dq * sigma for q, dq in zip(self.q0, self.dq0, strict=True))

    def speed_at(self, time: float) -> Numbers:
        """Return the velocities at a time since its begin [rad/s]."""
        left = max(1.0 - self.rate * max(time, 0.0), 0.0) if time > 0.0 else 1.0
        return tuple(left * dq for dq in self.dq0)


def ramp(q: Sequence[float], dq: Sequence[float], flange_speed: float, limits: Limits) -> Ramp:
    """Return the way to rest.

    Args:
        q: The joints as commanded last [rad], shape (n,).
        dq: Their velocities [rad/s], shape (n,).
        flange_speed: Speed of the flange there [m/s].
        limits: Of the joints.

    Raises:
        InputError: Something is not a finite number, or there are not n of them.
    """
    for name, values in (("q", q), ("dq", dq), ("flange_speed", (flange_speed,) * limits.joints)):
        if len(values) != limits.joints or not all(isfinite(value) for value in values):
            raise InputError(
                f"{name} is {tuple(values)}, expected {limits.joints} finite numbers; "
                "stop from the last setpoint that was sent"
            )
    moving = [i for i, velocity in enumerate(dq) if velocity != 0.0]
    if not moving:
        return Ramp(tuple(q), tuple(dq), inf)
    # The joints' limits bound r from above; flange and position limits ask for at least so much.
    most = min(limits.acceleration[i] / abs(dq[i]) for i in moving)
    least = STOP_DECELERATION / abs(flange_speed) if flange_speed != 0.0 else most
    for i in moving:
        room = limits.upper[i] - q[i] if dq[i] > 0.0 else q[i] - limits.lower[i]
        least = max(least, 0.5 * abs(dq[i]) / room if room > 0.0 else inf)
    return Ramp(tuple(q), tuple(dq), min(least, most))


def way_back(q: Sequence[float], measured: Sequence[float], limits: Limits) -> Path:
    """Return the path from the end of a ramp to where the arm is.

    Args:
        q: The joints at rest, as commanded last [rad], shape (n,).
        measured: The measured joints [rad], shape (n,).
        limits: Of the joints.
    """
    # A measured joint may be beyond a limit by its noise; a setpoint may not.
    end = [
        min(max(place, lower), upper)
        for place, lower, upper in zip(measured, limits.lower, limits.upper, strict=True)
    ]
    return path_within(
        q,
        end,
        [RETURN_SHARE * limit for limit in limits.velocity],
        [RETURN_SHARE * limit for limit in limits.acceleration],
    )
