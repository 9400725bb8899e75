"""Measurements of a run in memory: setpoints as sent, the encoder's counts, the robot's replies."""

from collections import deque
from collections.abc import Sequence
from math import inf, isnan, nan, pi, sqrt
from typing import Any, Final, TypeAlias

import numpy as np

from equipoise.control.ticks import Reply, Sample
from equipoise.safety import rules
from equipoise.safety.monitors import JointPlausibility, RepeatMonitor
from equipoise.safety.rules import Limits

HISTORY: Final = 64
"""Number of samples and of setpoints in memory: 64 ms at 1 kHz, for the fit at the release."""
MAX_ROUND_TRIP: Final = 0.0175
"""Round trip of a reply beyond which the robot's link stalls [s]: three and a half periods, because
a driver reads replies once per setpoint. A sound link takes 9 ms at most. A moving arm is sent
nothing until the replies have come: a link that stalls delivers all setpoints at once, and
the arm then goes to the last one at its highest speed. The joints of such a reply do not count,
because the time of their measurement is too uncertain."""


TimedJoints: TypeAlias = tuple[float, tuple[float, ...]]
"""A time [s], and all joints [rad]."""


class EncoderReadings:
    """Counts of the encoder, and their faults since the tick before."""

    def __init__(self, resolution: float) -> None:
        """Begin without a sample; `resolution` is the angle of one count [rad]."""
        self._resolution = resolution
        self.samples = deque[Sample](maxlen=HISTORY)
        """The last samples, the oldest first."""
        self.zero = nan
        """Count of the hanging pendulum; NaN before the reference."""
        self.dropouts, self.bridged = RepeatMonitor(), False
        """Monitor of lost samples, and whether one was bridged."""
        self._newest = inf  # time of the newest sample; before the first that of the first tick

    def add(self, samples: Sequence[Sample], now: float) -> None:
        """Add the samples of a tick at a time [s], and find their faults."""
        self._newest = samples[-1].time if samples else min(self._newest, now)
        self._missing, self._illegal, self._jump = 0, False, 0.0
        for sample in samples:
            self.samples.append(sample)
            if sample.missing and not isnan(self.zero):
                # Counts are absolute: a single missing one hides a millisecond and nothing else.
                serious = self.dropouts.add(sample.time) or sample.missing > 1
                self._missing += sample.missing if serious else 0
                self.bridged = self.bridged or not serious
            self._illegal = self._illegal or sample.illegal
            if len(self.samples) > 2:
                newest = [self.samples[i] for i in (-3, -2, -1)]
                times, counts = [last.time for last in newest], [last.counts for last in newest]
                jump = rules.unexplained_turn(times, counts, self._resolution)
                self._jump = max(self._jump, jump)

    def checks(self, now: float) -> dict[str, Any]:
        """Return the encoder's part of the safety inputs."""
        if isnan(self.zero):
            return {}
        return {
            "encoder_age": now - self._newest,
            "encoder_missing": self._missing,
            "encoder_illegal": self._illegal,
            "encoder_jump": self._jump,
        }

    def hanging(self) -> float:
        """Return the counts of the hanging pendulum after its whole turns so far."""
        turn = 2.0 * pi / self._resolution
        return self.zero + turn * round((self.samples[-1].counts - self.zero) / turn)

    def phi(self) -> float:
        """Return the newest angle from upright, in [-pi, pi) [rad]; NaN without a zero."""
        return self.angle(self.samples[-1].counts) if self.samples else nan

    def before(self, time: float, window: float) -> tuple[float, float] | None:
        """Return the newest counts within a window before a time [s] and their age [s], if any."""
        for sample in reversed(self.samples):
            age = time - sample.time
            if age >= 0.0:
                return (sample.counts - self.zero, age) if age <= window else None
        return None

    def falling(self, now: float, w2: float) -> tuple[float, float]:
        """Return phi [rad] and phi_dot [rad/s] now, of a pendulum that has fallen for 40 ms.

        A free fall near upright is a cosh(w t) + b sinh(w t) / w; a and b by least squares.
        """
        w, since = sqrt(w2), self.samples[-1].time - 0.04  # [s]; samples may come late
        falls = [sample for sample in self.samples if sample.time >= since]
        t = w * (np.array([sample.time for sample in falls]) - now)
        phi = [self.angle(sample.counts) for sample in falls]
        (a, b), *_ = np.linalg.lstsq(np.column_stack((np.cosh(t), np.sinh(t) / w)), phi)
        return float(a), float(b)

    def angle(self, counts: float) -> float:
        """Return the angle from upright of counts, in [-pi, pi) [rad]."""
        return (2.0 * pi - (counts - self.zero) * self._resolution) % (2.0 * pi) - pi


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
        self.fresh, self.late = False, False
        """Whether joints were measured, and whether a reply was late, since the tick before."""
        self.plausibility = JointPlausibility(limits)
        """Monitor of the joints' plausibility."""
        self.torque_at_home: tuple[float, ...] | None = None
        """External torques at home [N m]; None before the reference."""
        self.torque: tuple[float, ...] | None = None
        """New external torques less those at rest [N m]; None without any since the tick before."""
        self._torque_at_start: tuple[float, ...] | None = None
        self._torques = list[Sequence[float]]()  # at home, before the reference

    def add(self, replies: Sequence[Reply], rests_at_home: bool) -> list[TimedJoints]:
        """Add the replies of a tick; return the joints that count as measured."""
        self.fresh, self.late, self.torque = False, False, None
        measured = list[TimedJoints]()
        for reply in replies:
            self.answered = reply.sent
            late = reply.received - reply.sent > MAX_ROUND_TRIP
            self.late = self.late or late
            if reply.q is not None and not late:
                self.q, self.fresh = tuple(reply.q), True
                self.time = self.known_since = 0.5 * (reply.sent + reply.received)
                self.plausibility.add(reply.sent, reply.received, reply.q)
                measured.append((self.time, self.q))
            if reply.torque is not None:
                if self._torque_at_start is None:  # the way home has hardly begun
                    self._torque_at_start = tuple(reply.torque)
                at_rest = self.torque_at_home or self._torque_at_start
                self.torque = tuple(np.subtract(reply.torque, at_rest).tolist())
                if self.torque_at_home is None and rests_at_home:
                    self._torques.append(reply.torque)
        return measured

    def reference_torques(self) -> None:
        """Take the mean torques at home as those at rest."""
        if self._torques:
            self.torque_at_home = tuple(np.mean(self._torques, axis=0).tolist())
