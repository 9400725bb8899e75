"""Model of the incremental encoder on the pendulum's axis, and simulated recordings of a swing.

Counts are integers after x4 decoding. They increase with theta (sign = 1) or decrease (sign = -1).
A count represents the middle of its step, counts = floor(sign theta N / 2 pi + 1/2), so that the
quantization error of the angle is at most half a step, pi / N.
"""

from math import pi
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.jit import kernel
from equipoise.model.pendulum import PendulumParameters, swing
from equipoise.trajectory import Trajectory

STEPS_PER_PERIOD = 1024
"""Runge-Kutta steps per period of a simulated swing: eight times those of a fit, so that a test of
a fit does not share its integration error."""

Numbers = TypeVar("Numbers", float, npt.NDArray[np.float64])
"""A number or an array."""


@kernel
def counts_from_theta(theta: Numbers, counts_per_rev: float, sign: float) -> Numbers:
    """Return the encoder counts at an angle.

    Args:
        theta: Angle from hanging [rad], a number or an array.
        counts_per_rev: Counts per revolution N.
        sign: 1 if counts increase with theta, -1 if they decrease.

    Returns:
        An integral number of counts.

    Example:
        >>> float(counts_from_theta(3.141592653589793, 4096, 1))
        2048.0
    """
    counts: Any = np.floor(sign * theta * counts_per_rev / (2.0 * pi) + 0.5)
    return counts


@kernel
def theta_from_counts(counts: Numbers, counts_per_rev: float, sign: float) -> Numbers:
    """Return the angle in the middle of a count's step [rad].

    Args:
        counts: Counts, a number or an array.
        counts_per_rev: Counts per revolution N.
        sign: 1 if counts increase with theta, -1 if they decrease.

    Example:
        >>> float(theta_from_counts(-1024, 4096, -1))
        1.5707963267948966
    """
    return sign * counts * 2.0 * pi / counts_per_rev


def simulate_swing(
    parameters: PendulumParameters,
    *,
    theta0: float,
    duration: float,
    rate_hz: float,
    counts_per_rev: int,
    noise: float = 0.0,
    jitter: float = 0.0,
    zero_offset: float = 0.0,
    seed: int = 0,
) -> Trajectory:
    """Simulate the recording of a free swing, released at rest, by an encoder.

    Args:
        parameters: The pendulum.
        theta0: Angle from hanging at the release [rad].
        duration: Duration of the recording [s].
        rate_hz: Sampling rate [Hz].
        counts_per_rev: Encoder counts per revolution.
        noise: Standard deviation of white noise on the angle before quantization [rad].
        jitter: Standard deviation of the sampling times around their grid [s]; the time stamps
            are the true times.
        zero_offset: Encoder angle of the hanging pendulum [rad].
        seed: Seed of noise and jitter.

    Returns:
        The recording, without a known release.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * rate_hz) + 1) / rate_hz
    if jitter > 0.0:
        # Below half a sampling period, which keeps the order of the samples.
        time += np.clip(jitter * rng.standard_normal(time.size), -0.49 / rate_hz, 0.49 / rate_hz)
        time -= time[0]
    theta, theta_dot = np.empty_like(time), np.empty_like(time)
    h = 2.0 * pi / np.sqrt(parameters.w2) / STEPS_PER_PERIOD
    swing(time, theta0, 0.0, float(h), parameters, theta, theta_dot)
    reading: npt.NDArray[np.float64] = theta + zero_offset + noise * rng.standard_normal(time.size)
    counts = counts_from_theta(reading, counts_per_rev, 1)
    return Trajectory(
        time=time,
        theta=theta_from_counts(counts, counts_per_rev, 1),
        resolution=2.0 * pi / counts_per_rev,
        source="simulated swing",
    )
