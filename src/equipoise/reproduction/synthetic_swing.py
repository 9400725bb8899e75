"""Simulated free swing, as a substitute for a recording.

A trembling hand holds and releases the pendulum; an encoder counts. Identification has to recover
the release, the zero and the pendulum.
"""

from math import pi
from typing import Any

import numpy as np
from pydantic import Field

from equipoise import paper
from equipoise.artefacts import Value
from equipoise.identification.recording import Trajectory, simulate_swing
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import FINEST_ENCODER


class SyntheticSwing(Value):
    """Parameters of a simulated free swing, which identification has to recover."""

    period: float = Field(default=paper.FREE_SWING_PERIOD, ge=0.01, le=100.0)
    """Period of small swings [s]; the paper's."""
    c: float = Field(default=0.15, ge=0.0, le=1e3)
    """Viscous friction over inertia, b / I [1/s]. Recorded pendulums with an encoder on the spindle
    show 0.05 to 0.6."""
    theta: float = Field(default=0.8, gt=0.0, le=pi)
    """Angle from hanging at the release [rad], large enough for a swing that is not sinusoidal."""
    hold: float = Field(default=1.2, ge=0.0, le=1e3)
    """Time before the release [s]."""
    tremor: float = Field(default=0.01, ge=0.0, le=1.0)
    """Amplitude of the hand's tremor [rad]."""
    duration: float = Field(default=10.0, gt=0.0, le=1e4)
    """Recorded time after the release [s]: a dozen periods."""
    rate_hz: float = Field(default=1000.0, gt=0.0, le=1e5)
    """Sampling rate [Hz]."""
    counts_per_rev: int = Field(default=8192, gt=0, le=FINEST_ENCODER)
    """Encoder counts per revolution, after x4: a common encoder of 2048 lines."""
    noise: float = Field(default=5e-4, ge=0.0, le=1.0)
    """Standard deviation of the angle's noise per sample [rad]: vibration, play."""
    zero_offset: float = Field(default=0.005, ge=-pi, le=pi)
    """Encoder reading of the hanging pendulum [rad]: friction stopped it beside the vertical when
    it was referenced."""


def synthetic_swing(swing: SyntheticSwing, seed: int = 0) -> Trajectory:
    """Simulate the recording of a swing that a hand releases.

    Args:
        swing: The pendulum, the hand and the encoder.
        seed: Seed of the hand and of the noise.

    Returns:
        The recording, without the time of the release.
    """
    w2 = (2.0 * pi / swing.period) ** 2
    # The pivot is at rest, so that its coupling k is irrelevant.
    encoder = {"duration", "rate_hz", "counts_per_rev", "noise", "zero_offset"}
    options: dict[str, Any] = swing.model_dump(include=encoder)
    options |= {"theta0": swing.theta, "seed": seed}
    free = simulate_swing(PendulumParameters(w2=w2, k=0.0, c=swing.c), **options)
    held = np.arange(round(swing.hold * swing.rate_hz)) / swing.rate_hz
    # The tremor fades with the square of the remaining time, so that the release is at rest.
    left = 1.0 - held / swing.hold if swing.hold > 0.0 else held
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(0.0, 2.0 * pi, 2)
    hand = np.sin(2.0 * pi * 1.7 * held + phase[0]) + 0.5 * np.sin(2.0 * pi * 4.1 * held + phase[1])
    angle = swing.theta + swing.zero_offset + swing.tremor * left**2 * hand
    angle += swing.noise * rng.standard_normal(held.size)
    step = free.resolution
    theta = np.concatenate((np.floor(angle / step + 0.5) * step, free.values))
    time = np.concatenate((held, swing.hold + free.time))
    return Trajectory(time=time, theta=theta, resolution=step, source=free.source)
