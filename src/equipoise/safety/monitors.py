"""Monitors of a run: disturbances that repeat, and the plausibility of measured joints.

A rare single disturbance is bridged, several within a second stop a run: dropouts of encoder
samples, and stalls of the loop and of the robot's link while the arm moves. Each stall makes the
arm stop and start again; no single limit shows that it happens often.

Measured joints may be wrong in ways that no single reply shows: a server that repeats an old reply,
an encoder of a joint that slips, a user's driver that mixes up its columns. The targets of a stop
go back towards measured joints only where these pass all of

- several replies in order, each sent after the one before;
- from one reply to the next, no more velocity and acceleration than the joint can have
  (`equipoise.safety.rules.unexplained_step`);
- a posture that the last setpoints have passed, within what the servo may lag.
"""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from math import inf
from typing import Final

import numpy as np

from equipoise.arrays import Array
from equipoise.safety.rules import FOLLOWING_LIMIT, STILL_ANGLE, Limits, unexplained_step

MAX_REPEATS: Final = 3
"""Number of disturbances within `REPEAT_WINDOW` that stops a run."""
REPEAT_WINDOW: Final = 1.0
"""Window for counting disturbances [s]."""
MIN_REPLIES: Final = 5
"""Minimum number of replies with joints before a measured posture is used [-]."""


class RepeatMonitor:
    """Monitor of the disturbances of one kind in a run."""

    def __init__(self) -> None:
        """Start without a disturbance."""
        self._times = [-inf] * (MAX_REPEATS - 1)
        """Times of the last disturbances, the oldest first [s]."""

    def add(self, time: float) -> bool:
        """Add a disturbance at a time [s]; return whether it is one too many."""
        often = not time - self._times[0] > REPEAT_WINDOW
        self._times = [*self._times[1:], time]
        return often


class JointPlausibility:
    """Monitor of the measured joints of a run; a doubt stays until its end."""

    def __init__(self, limits: Limits) -> None:
        """Begin without a reply.

        Args:
            limits: Limits of the joints.
        """
        self._limits = limits
        self._last = deque[tuple[float, float, Sequence[float]]](maxlen=3)
        self._replies, self._doubt = 0, ""

    def add(self, sent: float, received: float, q: Sequence[float]) -> None:
        """Add the joints of a reply, the oldest first.

        Args:
            sent: Time at which its setpoint was sent [s].
            received: Time at which it was read [s].
            q: Measured joints [rad], shape (joints,).
        """
        self._replies += 1
        self._last.append((0.5 * (sent + received), 0.5 * (received - sent), q))
        if len(self._last) < 3 or self._doubt:
            return
        times, uncertainties, postures = zip(*self._last, strict=True)
        limits, timing = self._limits, max(uncertainties)
        for i, rate in enumerate(limits.velocity):
            steps = [b[i] - a[i] for a, b in pairwise(postures)]
            # Each end of a step may have been measured earlier or later.
            noise = 2.0 * (STILL_ANGLE + rate * timing)
            # Brakes and contacts are harder than any setpoint.
            most = 5.0 * limits.acceleration[i]
            # Written so that NaN is implausible.
            if not unexplained_step(times, steps, noise, rate, most) <= 0.0:
                self._doubt = f"joint {i + 1} was measured {steps[1]:+.3g} rad further at once"
                return

    def doubt(self, q: Sequence[float], commanded: Array) -> str:
        """Return why a measured posture is not plausible; empty for a plausible one.

        Args:
            q: The measured joints [rad], shape (joints,).
            commanded: The last setpoints before the stop [rad], shape (n, joints).
        """
        if self._doubt:
            return self._doubt
        if self._replies < MIN_REPLIES:
            return f"only {self._replies} replies came, expected {MIN_REPLIES}"
        low, high = commanded.min(axis=0), commanded.max(axis=0)
        away = np.maximum(low - np.array(q), np.array(q) - high)
        i = int(np.argmax(away))
        if not away[i] <= FOLLOWING_LIMIT:
            return f"joint {i + 1} is {away[i]:.3g} rad from all of its last setpoints"
        return ""
