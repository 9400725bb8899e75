r"""Detection of the release from the encoder alone: held, armed, released.

Armed
    The pendulum stands: |phi| < 1 deg and |mean phi_dot over 0.2 s| < 5 deg/s, for 0.5 s.
Released
    From armed, beyond 1.5 deg, the pendulum falls freely: over the last 40 ms phi_ddot agrees with
    w2 sin(phi) - c phi_dot within 30 %, its derivative with w2 phi_dot within the resolution of
    the counts, and phi_dot / (w phi) lies in 0.6 to 3, w = sqrt(w2). This has to hold for 10 ms.
    From \|phi + phi_dot / w\| = 4 deg on time is short: two samples suffice, also before 1.5 deg,
    and phi_ddot has the tolerance of the counts' noise.
Held again
    No fall was detected, and the pendulum is beyond 4 deg, has come back below 1.5 deg, or stayed
    between them for longer than a fall: the hand is still on.

phi + phi_dot / w grows as e^{w t}, by 40 % in 40 ms; phi - phi_dot / w dies away. The ratio is 1
where a fall from rest ends. It starts above 1 where a trembling hand releases with a rate: in a
fall from phi = 0 it comes below 1.4 only after the growing part has become 2.4 times as large.
`docs/decisions/release.md` gives the reasons for the ratio of 3, the 10 ms and the 4 deg.
"""

from collections import deque
from enum import Enum
from itertools import islice
from math import cosh, inf, radians, sin, sinh, sqrt
from typing import Final

import numpy as np

from equipoise.model.pendulum import PendulumParameters

ARM_AVERAGING_TIME: Final = 0.2
"""Averaging window of phi_dot [s]; longer than one period of a hand's tremor."""
FIT_WINDOW: Final = 0.04
"""Window of the cubic fit [s]."""
FALL_GROWTH_ANGLE: Final = radians(4.0)
"""|phi + phi_dot / w| from which a fall counts at once [rad]; at 11.7 deg no command can catch
the pendulum. A fall across 0 reaches it before 1.5 deg."""
MIN_SAMPLE_SPACING: Final = 4e-4
"""Minimum spacing of samples [s]; closer ones are skipped, which bounds the memory."""


class ReleaseState(Enum):
    """Holder of the pendulum."""

    HELD = "held"
    """Held by a hand, or unknown."""
    ARMED = "armed"
    """Held still by a hand, which may release it."""
    RELEASED = "released"
    """Released: it falls, and has to be balanced now."""


class ReleaseDetector:
    """Detector of a release, from successive encoder samples; `RELEASED` stays."""

    def __init__(self, pendulum: PendulumParameters) -> None:
        """Start with the pendulum held.

        Args:
            pendulum: The pendulum in use; w2 and c are needed.
        """
        self._w2, self._c, self._w = pendulum.w2, pendulum.c, sqrt(pendulum.w2)
        self.state: ReleaseState
        """Holder of the pendulum."""
        self._samples = deque[tuple[float, float]]()  # those of the averaging time: t, phi
        self._deny()

    def feed(self, time: float, phi: float) -> ReleaseState:
        """Process a sample.

        Args:
            time: Time of the sample [s].
            phi: Angle from upright, in [-pi, pi) [rad].

        Returns:
            The holder of the pendulum now.
        """
        samples = self._samples
        since_last = time - samples[-1][0] if samples else inf
        if self.state is ReleaseState.RELEASED or 0.0 <= since_last < MIN_SAMPLE_SPACING:
            return self.state
        if not 0.0 <= since_last <= 0.02:  # [s]: held after a longer gap
            self._deny()
            samples.clear()
        samples.append((time, phi))
        # The oldest sample is the newest one that is at least 0.2 s old.
        while len(samples) > 1 and time - samples[1][0] >= ARM_AVERAGING_TIME:
            samples.popleft()
        if self.state is ReleaseState.HELD:
            self._wait(time, phi)
        else:
            self._watch(time, phi)
        return self.state

    def _deny(self) -> None:
        self.state = ReleaseState.HELD
        self._still_since = self._beyond_since = self._falling_since = inf

    def _wait(self, time: float, phi: float) -> None:
        """Arm a pendulum that has been still for long enough."""
        before, phi_before = self._samples[0]
        long_enough = time - before >= ARM_AVERAGING_TIME
        # The innermost boxes of the paper's table, and half of its innermost interval of rates.
        still = abs(phi) < radians(1.0) and abs(phi - phi_before) < radians(5.0) * (time - before)
        if not (long_enough and still):
            self._still_since = inf
            return
        self._still_since = min(self._still_since, time)
        if time - self._still_since >= 0.5:  # [s]
            self.state = ReleaseState.ARMED

    def _watch(self, time: float, phi: float) -> None:
        """Decide whether an armed pendulum falls or is held."""
        beyond = abs(phi) > radians(1.5)
        if not beyond and self._beyond_since < inf:
            self._deny()
            return
        falls, grown = self._falls(time)
        falls = falls and (beyond or grown >= FALL_GROWTH_ANGLE)
        self._falling_since = min(self._falling_since, time) if falls else inf
        # [s]: a tremor's acceleration passes through that of a fall in a third of 10 ms; of a fast
        # fall two successive samples at 1 kHz suffice.
        min_time = 0.01 if grown < FALL_GROWTH_ANGLE else 5e-4
        if falls and time - self._falling_since >= min_time:
            self.state = ReleaseState.RELEASED
        elif beyond:
            self._beyond_since = min(self._beyond_since, time)
            # A fall to 4 deg takes 0.12 s from near 0, 0.13 s from 1 deg, 0.15 s from 1.3 deg.
            if abs(phi) > radians(4.0) or time - self._beyond_since > 0.2:
                self._deny()

    def _falls(self, now: float) -> tuple[bool, float]:
        """Return whether the last 40 ms look like a fall, and |phi + phi_dot / w| [rad]."""
        most = int(FIT_WINDOW / MIN_SAMPLE_SPACING) + 1
        newest_first = np.array(list(islice(reversed(self._samples), most)))
        # In half windows from the middle, for the condition of the fit.
        half = 0.5 * FIT_WINDOW
        t = (newest_first[:, 0] - now) / half + 1.0
        within = t >= -1.0
        if within.sum() < 12:  # too few for a cubic
            return False, 0.0
        powers = t[within, None] ** np.arange(4)
        a, b, d, e = np.linalg.solve(powers.T @ powers, powers.T @ newest_first[within, 1])
        phi, phi_dot = float(a), float(b) / half
        phi_ddot, jerk = 2.0 * float(d) / half**2, 6.0 * float(e) / half**3
        free = self._w2 * sin(phi) - self._c * phi_dot
        off, off_jerk = abs(phi_ddot - free), abs(jerk - self._w2 * phi_dot)
        # Propagate from the middle as a free fall: the ends of a cubic are less certain.
        w = self._w
        c, s = cosh(w * half), sinh(w * half)
        phi, phi_dot = phi * c + phi_dot * s / w, phi * w * s + phi_dot * c
        grown = abs(phi + phi_dot / w)
        # 8192 counts at 1 kHz give phi_ddot to 0.6 rad/s^2 (one standard deviation).
        fraction = 0.3 * abs(free)
        tolerance = fraction if grown < FALL_GROWTH_ANGLE else max(fraction, 1.0)
        # Counts give it to 170 rad/s^3. A tremor of 4 Hz differs by 300, one of 10 Hz by 1700.
        agrees = off <= tolerance and off_jerk <= 300.0
        # The ratio's bounds, without a division by phi.
        along = phi_dot if phi > 0.0 else -phi_dot
        fast = 0.6 * w * abs(phi) <= along <= 3.0 * w * abs(phi)
        return agrees and fast, grown
