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

    zero = 0.3

    def __init__(self, height):
        self.height, self.start = height, 0.0
        self._time = np.arange(0.0, 60.0, 0.0005)
        begin = height + self.tremor(RELEASE)
        self._theta, _ = swing(self._time, begin, 0.0, 0.0005, PENDULUM.parameters())

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
