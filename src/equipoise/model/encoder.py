"""The incremental encoder on the pendulum's axis, and the swing that it would record.

Counts are whole numbers after x4 decoding. They grow with theta (sign = 1) or fall (sign = -1),
and a count stands for the middle of its step: counts = floor(sign theta N / 2 pi + 1/2), so that
the angle read back is wrong by at most half a step, pi / N.
"""

from math import pi
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.model.pendulum import PendulumParameters, swing
from equipoise.trajectory import Trajectory

STEPS_PER_PERIOD = 1024
"""Runge-Kutta steps in a period of a simulated swing: four times finer than those of a fit, so
that a fit is not tested against its own errors."""

Numbers = TypeVar("Numbers", float, npt.NDArray[np.float64])
"""A number or an array, taken element by element."""


@kernel
def counts_from_theta(theta: Numbers, counts_per_rev: float, sign: float) -> Numbers:
    """Return what the encoder counts at an angle.

    Args:
        theta: Angle from hanging [rad]; an array is taken element by element.
        counts_per_rev: Counts per revolution N.
        sign: 1 if counts grow with theta, -1 if they fall.

    Returns:
        A whole number of counts.

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
        counts: Counts; an array is taken element by element.
        counts_per_rev: Counts per revolution N.
        sign: 1 if counts grow with theta, -1 if they fall.

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
    """Record a simulated free swing, let go at rest, as an encoder would.

    Args:
        parameters: The pendulum.
        theta0: Angle from hanging at the release [rad].
        duration: How long to record [s].
        rate_hz: Samples per second [Hz].
        counts_per_rev: Encoder counts per revolution.
        noise: Standard deviation of white noise on the angle before it is counted [rad].
        jitter: Standard deviation of the sampling times around their grid [s]; the time stamps
            tell the true times.
        zero_offset: Angle that the encoder reads when the pendulum hangs [rad].
        seed: Seed of noise and jitter.

    Returns:
        The recording; nothing is said about the release.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * rate_hz) + 1) / rate_hz
    if jitter > 0.0:
        # Never as much as half a sample: the order of the samples stays.
        time += np.clip(jitter * rng.standard_normal(time.size), -0.49 / rate_hz, 0.49 / rate_hz)
        time -= time[0]
    theta, theta_dot = np.empty_like(time), np.empty_like(time)
    h = 2.0 * pi / np.sqrt(parameters.w2) / STEPS_PER_PERIOD
    swing(time, theta0, 0.0, float(h), parameters, theta, theta_dot)
    seen: npt.NDArray[np.float64] = theta + zero_offset + noise * rng.standard_normal(time.size)
    counts = counts_from_theta(seen, counts_per_rev, 1)
    return Trajectory(
        time=time,
        theta=theta_from_counts(counts, counts_per_rev, 1),
        resolution=2.0 * pi / counts_per_rev,
        source="simulated swing",
    )
