"""Measurements of a run in memory: setpoints as sent, the encoder's counts, the robot's replies."""

from collections import deque
from collections.abc import Sequence
from math import cosh, inf, nan, pi, sinh, sqrt
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.control.ticks import Reply, Sample
from equipoise.safety import rules
from equipoise.safety.dropouts import DropoutMonitor
from equipoise.safety.plausibility import JointPlausibility
from equipoise.safety.rules import Limits

Array = npt.NDArray[np.float64]

HISTORY: Final = 64
"""Number of samples and of setpoints in memory: 64 ms at 1 kHz, for the fit at the release."""
SENDING_TIME: Final = 0.001
"""Tolerance of the time at which a setpoint is sent [s]."""
MAX_TIMED_REPLY: Final = 0.020
"""Maximum round trip of a reply whose joints count as measured [s]: in a longer one the time of
their measurement is too uncertain. A link to a robot takes 9 ms at most. With longer round trips
only, the age of the measurement stops the run (`Outcome.MEASUREMENT_STALE`)."""
FALL_WINDOW: Final = 0.04
"""Window for estimating the state at release [s]."""


class SetpointHistory:
    """The last setpoints sent."""

    def __init__(self, q: Sequence[float]) -> None:
        """Begin with an arm that rests at `q` [rad]."""
        self.setpoints: Array = np.tile(np.array(q, np.float64), (HISTORY, 1))
        """The last setpoints [rad], shape (HISTORY, joints), each at its number modulo HISTORY."""
        self._sent_at, self._count = np.full(HISTORY, -inf), 0

    def store(self, time: float, q: Sequence[float]) -> None:
        """Store a setpoint [rad] that is sent at a time [s]."""
        place = self._count % HISTORY
        self._sent_at[place], self.setpoints[place] = time, q
        self._count += 1

    def begin_anew(self, unsent: int) -> tuple[float, ...]:
        """Forget unsent setpoints; return the last one sent [rad]."""
        self._count -= unsent
        last = (self._count - 1) % HISTORY
        return tuple(self.setpoints[last].tolist())

    def last_two(self) -> tuple[list[float], list[float]]:
        """Return the last two setpoints [rad], the older one first."""
        before, last = ((self._count - n) % HISTORY for n in (2, 1))
        return self.setpoints[before].tolist(), self.setpoints[last].tolist()

    def in_force(self, time: float) -> tuple[float, ...]:
        """Return the setpoint in force at a time [s]."""
        place = rules.newest_before(self._sent_at, self._count, time)
        return tuple(self.setpoints[place].tolist())

    def unanswered_time(self, now: float, answered: float) -> float:
        """Return the time since the oldest setpoint without a reply was sent [s]; or 0.

        Args:
            now: The time [s].
            answered: Time at which the newest setpoint with a reply was sent [s].
        """
        oldest = now
        for back in range(1, HISTORY):
            sent = float(self._sent_at[(self._count - back) % HISTORY])
            if sent <= answered + SENDING_TIME:
                break
            oldest = sent
        return max(now - oldest, 0.0)


class EncoderReadings:
    """Counts of the encoder, and their faults since the tick before."""

    def __init__(self, resolution: float) -> None:
        """Begin without a sample; `resolution` is the angle of one count [rad]."""
        self._resolution = resolution
        self.samples = deque[Sample](maxlen=HISTORY)
        """The last samples, the oldest first."""
        self.zero: float | None = None
        """Count of the hanging pendulum; None before the reference."""
        self.dropouts = DropoutMonitor()
        """Monitor of lost samples."""
        self._missing, self._illegal, self._jump = 0, False, 0.0

    def add(self, sample: Sample) -> None:
        """Add the newest sample."""
        samples = self.samples
        samples.append(sample)
        if sample.missing and self.zero is not None:
            self._missing += self.dropouts.serious(sample.time, sample.missing)
        self._illegal = self._illegal or sample.illegal
        if len(samples) > 2:
            last = [samples[i] for i in (-3, -2, -1)]
            times, counts = [one.time for one in last], [one.counts for one in last]
            jump = rules.unexplained_turn(times, counts, self._resolution)
            self._jump = max(self._jump, jump)

    def take_checks(self, now: float) -> dict[str, Any]:
        """Return the encoder's part of the safety inputs, and forget its faults."""
        found = self._missing, self._illegal, self._jump
        self._missing, self._illegal, self._jump = 0, False, 0.0
        if self.zero is None or not self.samples:
            return {}
        names = "encoder_missing", "encoder_illegal", "encoder_jump"
        age = now - self.samples[-1].time
        return {"encoder_age": age, **dict(zip(names, found, strict=True))}

    def phi(self) -> float:
        """Return the newest angle from upright, in [-pi, pi) [rad]; NaN without a zero."""
        if self.zero is None or not self.samples:
            return nan
        return self._angle(self.samples[-1].counts)

    def before(self, time: float, window: float) -> tuple[float, float] | None:
        """Return the newest counts within a window before a time [s] and their age [s], if any."""
        for sample in reversed(self.samples):
            age = time - sample.time
            if age > window:
                break
            if age >= 0.0:
                return sample.counts - (self.zero or 0.0), age
        return None

    def falling(self, now: float, w2: float) -> tuple[float, float]:
        """Return phi [rad] and phi_dot [rad/s] now, of a pendulum that has fallen for 40 ms.

        A free fall near upright is a cosh(w t) + b sinh(w t) / w; a and b by least squares.
        """
        w = sqrt(w2)
        cc = cs = ss = cy = sy = 0.0
        for sample in reversed(self.samples):
            t = sample.time - now
            if t < -FALL_WINDOW:
                break
            c, s, phi = cosh(w * t), sinh(w * t) / w, self._angle(sample.counts)
            cc, cs, ss = cc + c * c, cs + c * s, ss + s * s
            cy, sy = cy + c * phi, sy + s * phi
        determinant = cc * ss - cs * cs
        return (ss * cy - cs * sy) / determinant, (cc * sy - cs * cy) / determinant

    def _angle(self, counts: float) -> float:
        return (2.0 * pi - (counts - (self.zero or 0.0)) * self._resolution) % (2.0 * pi) - pi


class ArmReadings:
    """Measured joints and external torques, from the robot's replies."""

    def __init__(self, q: Sequence[float], limits: Limits) -> None:
        """Begin with an arm that was measured at rest at `q` [rad]."""
        self.q, self.time = tuple(q), -inf
        """Newest measured joints [rad], and the time of their measurement [s]."""
        self.known_since = inf
        """Time from which the age of the measurement counts [s]."""
        self.answered = -inf
        """Time at which the newest setpoint with a reply was sent [s]."""
        self.fresh = False
        """Whether joints were measured since the tick before."""
        self.plausibility = JointPlausibility(limits)
        """Monitor of the joints' plausibility."""
        self.torque_at_home: Array | None = None
        """External torques at home [N m]; None before the reference."""
        self._torque: Array | None = None
        self._torque_at_start: Array | None = None
        self._torque_sum, self._torques = np.zeros(len(q)), 0

    def begin_tick(self) -> None:
        """Forget what is new."""
        self.fresh, self._torque = False, None

    def add(self, reply: Reply, rests_at_home: bool) -> bool:
        """Add the newest reply; return whether its joints count as measured."""
        self.answered = reply.sent
        counts = reply.q is not None and reply.received - reply.sent <= MAX_TIMED_REPLY
        if reply.q is not None and counts:
            self.q, self.fresh = tuple(reply.q), True
            self.time = self.known_since = 0.5 * (reply.sent + reply.received)
            self.plausibility.add(reply.sent, reply.received, reply.q)
        if reply.torque is not None:
            self._torque = np.array(reply.torque)
            if self._torque_at_start is None:  # the way home has hardly begun
                self._torque_at_start = self._torque
            if self.torque_at_home is None and rests_at_home:
                self._torque_sum += reply.torque
                self._torques += 1
        return counts

    def reference_torques(self) -> None:
        """Take the mean torques at home as those at rest."""
        if self._torques:
            self.torque_at_home = self._torque_sum / self._torques

    def new_torque(self) -> tuple[float, ...] | None:
        """Return new external torques less those at rest [N m]; None without new ones."""
        at_rest = self._torque_at_start if self.torque_at_home is None else self.torque_at_home
        if at_rest is None or self._torque is None:
            return None
        return tuple((self._torque - at_rest).tolist())
