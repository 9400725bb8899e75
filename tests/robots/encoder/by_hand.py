"""A pendulum that hangs, is lifted by a hand, held with a tremor, and let go."""

from math import pi, sin

import numpy as np

from equipoise.model.pendulum import Pendulum, swing

PENDULUM = Pendulum.assumed(70.2, 0.15)
HANGS, RISES, HOLDS = 3.0, 1.0, 2.0
"""How long each takes [s]."""
RELEASE = HANGS + RISES + HOLDS
TREMOR = np.deg2rad(0.3)


class ByHand:
    """theta against time [rad], as a callable."""

    def __init__(
        self, height=0.8, *, start=0.0, zero=0.3, length=60.0, theta_dot=0.0, pendulum=PENDULUM
    ):
        self.height = height
        self.start = start
        self.zero = zero
        self._time = np.arange(0.0, length, 0.0005)
        self._theta, rate = np.empty_like(self._time), np.empty_like(self._time)
        begin = height + self.tremor(RELEASE)
        swing(self._time, begin, theta_dot, 0.0005, pendulum.parameters(), self._theta, rate)

    def tremor(self, time):
        return TREMOR * sin(2.0 * pi * 7.0 * time)

    def __call__(self, now):
        time = now - self.start
        if time < HANGS:
            return self.zero
        if time < HANGS + RISES:
            s = (time - HANGS) / RISES
            return self.zero + self.height * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        if time < RELEASE:
            return self.zero + self.height + self.tremor(time)
        return self.zero + float(np.interp(time - RELEASE, self._time, self._theta))
