"""Simulated free swing, as a substitute for a recording.

A trembling hand holds and releases the pendulum; an encoder counts. Identification has to recover
the release, the zero and the pendulum.
"""

from math import pi
from typing import Final

import numpy as np

from equipoise import paper
from equipoise.identification.recording import Trajectory, simulate_swing
from equipoise.model.pendulum import PendulumParameters

SIMULATED_C: Final = 0.15
"""Viscous friction over inertia, b / I [1/s]. Recorded pendulums with an encoder on the spindle
show 0.05 to 0.6."""
SIMULATED_HOLD: Final = 1.2
"""Time before the release [s]."""


def synthetic_swing(seed: int = 0, *, period: float = paper.FREE_SWING_PERIOD) -> Trajectory:
    """Simulate the recording of a swing that a hand releases.

    Args:
        seed: Seed of the hand and of the noise.
        period: Period of small swings [s]; by default the paper's.

    Returns:
        The recording, without the time of the release.
    """
    rate = 1000.0  # [Hz]
    noise = 5e-4  # [rad], standard deviation per sample: vibration, play
    release = 0.8  # [rad] from hanging: large enough for a swing that is not sinusoidal
    tremor = 0.01  # [rad], of the hand
    zero = 0.005  # [rad]: friction stopped the pendulum beside the vertical when referenced
    # The pivot is at rest, so that its coupling k is irrelevant.
    free = simulate_swing(
        PendulumParameters(w2=(2.0 * pi / period) ** 2, k=0.0, c=SIMULATED_C),
        theta0=release,
        duration=10.0,  # [s]: a dozen periods
        rate_hz=rate,
        counts_per_rev=8192,  # a common encoder of 2048 lines, after x4
        noise=noise,
        zero_offset=zero,
        seed=seed,
    )
    held = np.arange(round(SIMULATED_HOLD * rate)) / rate
    # The tremor fades with the square of the remaining time, so that the release is at rest.
    left = 1.0 - held / SIMULATED_HOLD
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(0.0, 2.0 * pi, 2)
    hand = np.sin(2.0 * pi * 1.7 * held + phase[0]) + 0.5 * np.sin(2.0 * pi * 4.1 * held + phase[1])
    angle = release + zero + tremor * left**2 * hand
    angle += noise * rng.standard_normal(held.size)
    step = free.resolution
    theta = np.concatenate((np.floor(angle / step + 0.5) * step, free.values))
    time = np.concatenate((held, SIMULATED_HOLD + free.time))
    return Trajectory(time=time, theta=theta, resolution=step, source=free.source)
