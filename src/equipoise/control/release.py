r"""Is a hand on the pendulum? Told from the encoder alone: held, armed, released.

Armed
    The pendulum stands: |phi| < 1 deg and |mean phi_dot over 0.2 s| < 5 deg/s, for 0.5 s.
Released
    From armed, beyond 1.5 deg, it falls as a pendulum falls by itself: over the last 40 ms
    phi_ddot agrees with w2 sin(phi) - c phi_dot within 30 %, its derivative with w2 phi_dot as far
    as counts show it, and phi_dot / (w phi) lies in 0.6 to 3, w = sqrt(w2). This has to hold for
    10 ms. Where \|phi + phi_dot / w\| has reached 4 deg there is no time left: then two samples
    do, also before 1.5 deg, and phi_ddot may be off by what counts leave open.
Held again
    It was not found falling, and is beyond 4 deg, has come back below 1.5 deg, or stayed between
    them for longer than a fall does: the hand is still on.

phi + phi_dot / w grows as e^{w t}, by 40 % in 40 ms; phi - phi_dot / w dies away. The ratio is 1
where a fall from rest ends. It starts above 1 where a trembling hand lets go with a rate: what
falls from phi = 0 comes below 1.4 only after the growing part has become 2.4 times as large. Why
the ratio goes to 3 and what the 10 ms and the 4 deg are for: `docs/decisions/release.md`.
"""

from enum import Enum
from math import cosh, inf, isfinite, radians, sin, sinh, sqrt
from typing import Final

import numpy as np

from equipoise.model.pendulum import PendulumParameters

ARM_ANGLE: Final = radians(1.0)
"""Armed only where |phi| stays below this [rad]: the innermost boxes of the paper's table."""
ARM_RATE: Final = radians(5.0)
"""... and |mean phi_dot| below this [rad/s]: half the paper's innermost interval."""
ARM_MEAN: Final = 0.2
"""That mean is over so long [s]: a period and more of a hand's tremor."""
ARM_TIME: Final = 0.5
"""Both have to last so long [s]."""
RELEASE_ANGLE: Final = radians(1.5)
"""A release is looked for beyond this |phi| [rad], or where it has `FALL_GROWTH_ANGLE`."""
HELD_ANGLE: Final = radians(4.0)
"""Whoever is beyond this |phi| [rad] without having been seen to fall is held."""
WINDOW: Final = 0.04
"""A cubic is fitted to the samples of so long [s]."""
AGREEMENT: Final = 0.3
"""phi_ddot may differ from that of a free fall by this share of it ..."""
NOISE: Final = 1.0
"""... or, where it has `FALL_GROWTH_ANGLE`, by this [rad/s^2]: 8192 counts at 1 kHz show it to 0.6
(one standard deviation)."""
JERK: Final = 300.0
"""Its derivative may differ by this [rad/s^3]: counts show it to 170. A tremor of 4 Hz with the
rate of a fall that is still near 0 differs by as much, one of 10 Hz by 1700."""
RATIO: Final = (0.6, 3.0)
"""Where phi_dot / (w phi) may lie."""
FALL_TIME: Final = 0.01
"""A fall has to be seen for so long [s]: the acceleration of a tremor passes through that of a
fall in a third of this."""
FALL_GROWTH_ANGLE: Final = radians(4.0)
"""... unless |phi + phi_dot / w| has reached this [rad]; at 11.7 deg no command can catch it.
What falls across 0 reaches it before 1.5 deg."""
FAST_FALL_TIME: Final = 5e-4
"""Then it has to be seen for so long only [s]: by two samples in a row at 1 kHz."""
MAX_FALL_TIME: Final = 0.2
"""A fall takes less than this from 1.5 to 4 deg [s]: 0.12 s where it began near 0, 0.13 s at 1 deg,
0.15 s at 1.3 deg."""
MAX_SAMPLE_GAP: Final = 0.02
"""After a gap of so long [s] all is forgotten, and the hand is on."""
MIN_SAMPLE_SPACING: Final = 4e-4
"""Samples that follow closer than this [s] are passed over, so that the memory has a size."""
BUFFER_SIZE: Final = 512
"""Samples in the memory: those of 0.2 s."""
MIN_FIT_SAMPLES: Final = 12
"""Fewer samples in the window give no cubic."""
NEWEST_SAMPLES: Final = np.arange(int(WINDOW / MIN_SAMPLE_SPACING) + 1)
"""So many samples, counted back from the newest, lie in the window at most."""
POWERS: Final = np.arange(4)
"""Of a cubic."""


class ReleaseState(Enum):
    """Whose the pendulum is."""

    HELD = "held"
    """A hand's, or nobody can tell."""
    ARMED = "armed"
    """A hand's that holds it still: it may let go."""
    RELEASED = "released"
    """Its own: it falls, and has to be balanced now."""


class ReleaseDetector:
    """Tells from one encoder sample after the other whether a hand has let go.

    Its memory has a fixed size. `RELEASED` stays until `reset`.
    """

    def __init__(self, pendulum: PendulumParameters) -> None:
        """Begin with the hand on.

        Args:
            pendulum: The pendulum in use; w2 and c are needed.
        """
        self._w2, self._c, self._w = pendulum.w2, pendulum.c, sqrt(pendulum.w2)
        self._time, self._phi = np.zeros(BUFFER_SIZE), np.zeros(BUFFER_SIZE)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the hand is on."""
        self.grip = ReleaseState.HELD
        """Whose the pendulum is."""
        self.denied = False
        """Whether it was armed before, and the hand turned out to be still on."""
        self._forget()

    def feed(self, time: float, phi: float) -> ReleaseState:
        """Take a sample.

        Args:
            time: When it was taken [s].
            phi: Angle from upright, in [-pi, pi) [rad].

        Returns:
            Whose the pendulum is now.
        """
        if self.grip is ReleaseState.RELEASED:
            return self.grip
        if not (isfinite(time) and isfinite(phi)):
            self._forget()
            return self.grip
        since_last = time - self._last
        if 0.0 <= since_last < MIN_SAMPLE_SPACING:
            return self.grip
        if not 0.0 <= since_last <= MAX_SAMPLE_GAP:
            self._forget()
        self._keep(time, phi)
        if self.grip is ReleaseState.HELD:
            self._wait(time, phi)
        else:
            self._watch(time, phi)
        return self.grip

    def _forget(self) -> None:
        self._deny()
        self._count, self._oldest, self._last = 0, 0, -inf

    def _deny(self) -> None:
        self.denied = self.grip is ReleaseState.ARMED or self.denied
        self.grip = ReleaseState.HELD
        self._still_since = self._beyond_since = self._falling_since = inf

    def _keep(self, time: float, phi: float) -> None:
        place = self._count % BUFFER_SIZE
        self._time[place], self._phi[place] = time, phi
        self._count += 1
        self._last = time
        # The newest sample that is at least 0.2 s old.
        while self._oldest + 1 < self._count and time - self._of(self._oldest + 1)[0] >= ARM_MEAN:
            self._oldest += 1

    def _of(self, number: int) -> tuple[float, float]:
        """Return time [s] and phi [rad] of a sample."""
        return float(self._time[number % BUFFER_SIZE]), float(self._phi[number % BUFFER_SIZE])

    def _wait(self, time: float, phi: float) -> None:
        """Arm where it has been still for long enough."""
        before, phi_before = self._of(self._oldest)
        long_enough = time - before >= ARM_MEAN
        if not (
            long_enough
            and abs(phi) < ARM_ANGLE
            and abs(phi - phi_before) < ARM_RATE * (time - before)
        ):
            self._still_since = inf
            return
        self._still_since = min(self._still_since, time)
        if time - self._still_since >= ARM_TIME:
            self.grip, self.denied = ReleaseState.ARMED, False

    def _watch(self, time: float, phi: float) -> None:
        """See whether it falls or is held."""
        beyond = abs(phi) > RELEASE_ANGLE
        if not beyond and self._beyond_since < inf:
            self._deny()
            return
        falls, grown = self._falls(time)
        falls = falls and (beyond or grown >= FALL_GROWTH_ANGLE)
        self._falling_since = min(self._falling_since, time) if falls else inf
        if falls and time - self._falling_since >= (
            FALL_TIME if grown < FALL_GROWTH_ANGLE else FAST_FALL_TIME
        ):
            self.grip = ReleaseState.RELEASED
        elif beyond:
            self._beyond_since = min(self._beyond_since, time)
            if abs(phi) > HELD_ANGLE or time - self._beyond_since > MAX_FALL_TIME:
                self._deny()

    def _falls(self, now: float) -> tuple[bool, float]:
        """Return whether the last 40 ms look like a fall, and |phi + phi_dot / w| [rad]."""
        places = (self._count - 1 - NEWEST_SAMPLES[: self._count]) % BUFFER_SIZE
        # In half windows from the middle, so that all is of one size.
        half = 0.5 * WINDOW
        t = (self._time[places] - now) / half + 1.0
        within = t >= -1.0
        if within.sum() < MIN_FIT_SAMPLES:
            return False, 0.0
        powers = t[within, None] ** POWERS
        a, b, d, e = np.linalg.solve(powers.T @ powers, powers.T @ self._phi[places[within]])
        phi, phi_dot = float(a), float(b) / half
        phi_ddot, jerk = 2.0 * float(d) / half**2, 6.0 * float(e) / half**3
        free = self._w2 * sin(phi) - self._c * phi_dot
        off, off_jerk = abs(phi_ddot - free), abs(jerk - self._w2 * phi_dot)
        # Now: from the middle on it falls freely, if it does; a cubic's ends are less sure.
        w = self._w
        c, s = cosh(w * half), sinh(w * half)
        phi, phi_dot = phi * c + phi_dot * s / w, phi * w * s + phi_dot * c
        grown = abs(phi + phi_dot / w)
        share = AGREEMENT * abs(free)
        agrees = (
            off <= (share if grown < FALL_GROWTH_ANGLE else max(share, NOISE)) and off_jerk <= JERK
        )
        # The ratio's bounds, without a division by phi.
        along = phi_dot if phi > 0.0 else -phi_dot
        fast = RATIO[0] * w * abs(phi) <= along <= RATIO[1] * w * abs(phi)
        return agrees and fast, grown
