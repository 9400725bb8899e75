"""A simulated free swing that stands in for a recording, where there is no pendulum at hand.

A hand holds the pendulum, trembles and lets go; an encoder counts. Identification has to find the
release, the zero and the pendulum again.
"""

from math import pi

import numpy as np
from pydantic import Field

from equipoise import paper
from equipoise.artefacts import Value
from equipoise.model.encoder import simulate_swing
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import FINEST_ENCODER
from equipoise.trajectory import Trajectory


class SyntheticSwing(Value):
    """The free swing that stands in for a recording: what identification shall find again."""

    period: float = Field(default=paper.FREE_SWING_PERIOD, ge=0.01, le=100.0)
    """Period of small swings [s]; the paper's."""
    c: float = Field(default=0.15, ge=0.0, le=1e3)
    """Viscous friction over inertia, b / I [1/s]. Recorded pendulums with an encoder on the spindle
    show 0.05 to 0.6."""
    theta: float = Field(default=0.8, gt=0.0, le=pi)
    """Angle from hanging at which the hand lets go [rad]: large enough that the swing is not
    sinusoidal any more."""
    hold: float = Field(default=1.2, ge=0.0, le=1e3)
    """How long the hand holds the pendulum first [s]: identification has to find the release."""
    tremor: float = Field(default=0.01, ge=0.0, le=1.0)
    """How far the hand moves meanwhile [rad]."""
    duration: float = Field(default=10.0, gt=0.0, le=1e4)
    """How long the swing is recorded after the release [s]: a dozen periods."""
    rate_hz: float = Field(default=1000.0, gt=0.0, le=1e5)
    """Samples per second [Hz]."""
    counts_per_rev: int = Field(default=8192, gt=0, le=FINEST_ENCODER)
    """Encoder counts per revolution, after x4: a common encoder of 2048 lines."""
    noise: float = Field(default=5e-4, ge=0.0, le=1.0)
    """Standard deviation of what shakes the angle from sample to sample [rad]: vibration, play."""
    zero_offset: float = Field(default=0.005, ge=-pi, le=pi)
    """What the encoder reads when the pendulum hangs [rad]: friction stopped it beside the
    vertical when it was referenced."""


def synthetic_swing(swing: SyntheticSwing, seed: int = 0) -> Trajectory:
    """Record a simulated swing that a hand releases.

    Args:
        swing: The pendulum, the hand and the encoder.
        seed: Seed of the hand and of the noise.

    Returns:
        The recording; nothing in it says when the hand lets go.
    """
    w2 = (2.0 * pi / swing.period) ** 2
    # The coupling to the pivot does not matter: it is at rest.
    free = simulate_swing(
        PendulumParameters(w2=w2, k=0.0, c=swing.c),
        theta0=swing.theta,
        duration=swing.duration,
        rate_hz=swing.rate_hz,
        counts_per_rev=swing.counts_per_rev,
        noise=swing.noise,
        seed=seed,
        zero_offset=swing.zero_offset,
    )
    held = np.arange(round(swing.hold * swing.rate_hz)) / swing.rate_hz
    # The hand comes to rest before it lets go: its motion fades as the square of what is left.
    left = 1.0 - held / swing.hold if swing.hold > 0.0 else held
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(0.0, 2.0 * pi, 2)
    hand = np.sin(2.0 * pi * 1.7 * held + phase[0]) + 0.5 * np.sin(2.0 * pi * 4.1 * held + phase[1])
    seen = swing.theta + swing.zero_offset + swing.tremor * left**2 * hand
    seen += swing.noise * rng.standard_normal(held.size)
    step = free.resolution
    theta = np.concatenate((np.floor(seen / step + 0.5) * step, free.values))
    return Trajectory(
        time=np.concatenate((held, swing.hold + free.time)),
        theta=theta,
        resolution=step,
        source=free.source,
    )
