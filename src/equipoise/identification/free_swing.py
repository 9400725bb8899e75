"""Samples of a free swing, their prediction, and their detection in a recording.

A free pendulum turns at regular times, and its swings shrink. The fit takes the longest such
stretch, from turning point to turning point: a hand that holds, lifts or stops the pendulum turns
it at other times, and one that pushes it makes the swings grow. Of several swings in one recording
the longest is taken. At a turning point the initial state is known: an angle turns at rest, and a
rate in the lowest position.

Fixed integration steps make the prediction a smooth function of the unknowns, so that finite
differences give its sensitivities; an adaptive integrator would not.
"""

from math import pi, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array
from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory
from equipoise.model.pendulum import STEPS_PER_PERIOD, PendulumParameters, swing

W2, C, COULOMB, DRAG, THETA, THETA_DOT, OFFSET, SCALE = range(8)
"""Indices of the unknowns: four of the pendulum, its initial state, zero offset (or gyro bias), and
the true motion as a fraction of the recorded one, which is 1 except in a diagnosis."""

PERIOD_RANGE: Final = (0.05, 20.0)
"""Accepted range of the period of a small swing [s]: point pendulums of 0.6 mm and 100 m. Periods
outside indicate a wrong unit, mostly milliseconds taken for seconds."""
MIN_SAMPLES_PER_PERIOD: Final = 10.0
"""Minimum number of samples per period; with fewer, turning points are uncertain."""
NOISE_MULTIPLE: Final = 8.0
"""Minimum reversal after a turning point, in standard deviations of the noise: noise alone does
not reach it within the samples around a turn."""


class SwingRecording(NamedTuple):
    """Samples to fit."""

    time: Array
    """Time stamps [s], shape (n,)."""
    values: Array
    """Angle [rad], or rate [rad/s], as recorded; shape (n,)."""
    is_rate: bool
    """Whether a gyro recorded the rate."""
    period: float
    """Period of the swing [s]."""
    any_scale: bool = False
    """Whether SCALE is fitted as well."""

    def predict(self, unknowns: Array) -> Array:
        """Simulate the recorded values, shape (n,)."""
        thetas, theta_dots = np.empty_like(self.time), np.empty_like(self.time)
        w2, c, coulomb, drag, theta, theta_dot, offset, scale = map(float, unknowns)
        pendulum = PendulumParameters(w2, 0.0, c, coulomb, drag)
        h = self.period / STEPS_PER_PERIOD
        swing(self.time, scale * theta, scale * theta_dot, h, pendulum, thetas, theta_dots)
        return (theta_dots if self.is_rate else thetas) / scale + offset

    def residual(self, unknowns: Array) -> Array:
        """Return recorded minus predicted values, shape (n,); 1e30 where a prediction diverged."""
        missed = np.nan_to_num(self.values - self.predict(unknowns), nan=1e30)
        return np.clip(missed, -1e30, 1e30)

    def rms(self, unknowns: Array) -> float:
        """Return the root mean square residual."""
        return sqrt(float(np.mean(self.residual(unknowns) ** 2)))

    def noise(self, unknowns: Array, resolution: float = 0.0) -> float:
        """Estimate the white noise in the residual, at least that of the sensor's steps."""
        residual = self.residual(unknowns)
        return max(float(np.std(np.diff(residual))) / sqrt(2.0), resolution / sqrt(12.0))

    def misfit(self, unknowns: Array, resolution: float = 0.0) -> float:
        """Return the root mean square residual that noise does not explain."""
        noise = self.noise(unknowns, resolution)
        return sqrt(max(self.rms(unknowns) ** 2 - noise**2, 0.0))


def find_free_swing(trajectory: Trajectory) -> tuple[SwingRecording, Array]:
    """Return the freely swinging part of a recording, and an initial guess for its fit, shape (8,).

    Raises:
        RecordingError: There are too few samples, no oscillation above the noise, or less than one
            period of a free swing; or a unit is wrong.
    """
    time, values, is_rate = trajectory.time, trajectory.values, trajectory.theta is None
    duration, spread = float(np.ptp(time)), float(np.ptp(values))

    def refusal(fault: str) -> RecordingError:
        return RecordingError(
            f"{trajectory.source} {fault}: {len(time)} samples in {duration:.3g} s that vary by "
            f"{spread:.3g} rad, or rad/s; release the pendulum from 40 to 60 deg, with so little "
            f"friction that it swings for ten periods, record {MIN_SAMPLES_PER_PERIOD:g} samples "
            "or more in each, and give the unit in the column's name"
        )

    if len(time) < 2 * MIN_SAMPLES_PER_PERIOD:
        raise refusal("holds too few samples")
    turns = _turning_points(trajectory, spread)
    if len(turns) < 2:
        raise refusal("shows no oscillation")
    half = float(np.median(np.diff(time[turns])))
    spacing = np.diff(time[turns]) / half
    broken = (spacing < 0.6) | (spacing > 1.6) | _lifted_again(time, values, turns, spacing, half)
    edges = np.flatnonzero(np.concatenate(([True], broken, [True])))
    longest = int(np.argmax(np.diff(edges)))
    turns = turns[edges[longest] : edges[longest + 1]]
    swings = np.abs(np.diff(values[turns]))
    # A hand pushes as long as the swings grow, and may hold the pendulum at the first turn.
    largest = int(np.argmax(swings > 0.95 * np.max(swings))) if len(swings) else 0
    first = largest if trajectory.released else max(largest, 1)
    turns, swings = turns[first:], swings[first:]
    if len(turns) < 3:
        raise refusal("holds less than one period of a free swing")
    begin, end = float(time[turns[0]]), float(time[turns[-1]])
    period = 2.0 * float(np.median(np.diff(time[turns])))
    if (turns[-1] - turns[0]) * period / (end - begin) < MIN_SAMPLES_PER_PERIOD:
        raise refusal(f"holds too few samples in each period of {period:.3g} s")
    middle = float(np.median(values[turns[1:]] + values[turns[:-1]])) / 2.0
    lead = float(values[turns[0]]) - middle
    decay = 2.0 * float(np.log(swings[0] / swings[-1])) / (end - begin)
    spacing, size = np.diff(time[turns[:4]]), 0.5 * float(np.median(swings[:3]))
    w2 = _w2_from_period(2.0 * float(np.median(spacing)), size, is_rate)
    if not PERIOD_RANGE[0] <= 2.0 * pi / np.sqrt(w2) <= PERIOD_RANGE[1]:
        raise refusal(f"has a period of {period:.3g} s, expected {PERIOD_RANGE} s")
    root = float(np.sqrt(w2))
    # A faster pendulum would go over the top, and the fit would begin with a rotation.
    most = 1.98 * root if is_rate else 0.99 * pi
    state = [0.0, 0.0]
    state[is_rate] = min(max(lead, -most), most)
    part = slice(turns[0], turns[-1] + 1)
    start = np.array([w2, max(decay, 1e-3 * root), 0.0, 0.0, *state, middle, 1.0])
    return SwingRecording(time[part], values[part], is_rate, period), start


def _lifted_again(
    time: Array, values: Array, turns: npt.NDArray[np.intp], spacing: Array, half: float
) -> npt.NDArray[np.bool_]:
    """Return the swings between two turns that are a hand's, after the pendulum has swung freely.

    Swings and half periods of a free pendulum only shrink. Where a half period grows, missing
    samples make the times of the turns uncertain, and noise those of small swings.
    """
    swings, uncertain = np.abs(np.diff(values[turns])), (time[turns + 1] - time[turns - 1]) / half
    large = np.max(swings)
    farther = np.diff(swings) > 0.1 * large
    slower = np.diff(spacing) > 0.2 + 0.5 * np.convolve(uncertain, np.ones(3), mode="same")[1:-1]
    shrunk = swings[:-1] < np.maximum.accumulate(swings)[:-1] - 0.1 * large
    driven = shrunk & (farther | (slower & (swings[:-1] > 0.4 * large)))
    return np.append(driven, False) | np.append(False, driven)


def _turning_points(trajectory: Trajectory, spread: float) -> npt.NDArray[np.intp]:
    """Return the indices of the turning points that noise and the sensor's steps do not explain."""
    from scipy.signal import find_peaks

    values = trajectory.values
    third = np.diff(values, 3)  # of a smooth motion almost noise alone
    noise = 1.4826 * float(np.median(np.abs(third - np.median(third)))) / np.sqrt(20.0)
    # No sensor resolves less than 1e-6.
    if spread <= max(1.5 * NOISE_MULTIPLE * noise, 4.0 * trajectory.resolution, 1e-6):
        return np.zeros(0, np.intp)
    # A rattle or a tremor of 5 % of the range gives no turning points.
    reversal = max(NOISE_MULTIPLE * noise, 0.05 * spread, 2.5 * trajectory.resolution)
    first = 1e-6 * spread * np.linspace(1.0, 0.0, len(values))  # of equal values at a turn
    peaks = [find_peaks(sign * values + first, prominence=reversal)[0] for sign in (1.0, -1.0)]
    return np.sort(np.concatenate(peaks))


def _w2_from_period(period: float, amplitude: float, is_rate: bool) -> float:
    """Return w2 from period and amplitude A: T = 4 K(m) / sqrt(w2), with m = sin^2(A/2)."""
    from scipy.special import ellipk

    m = np.sin(0.5 * np.linspace(0.0, 0.97 * pi, 400)) ** 2
    K = np.asarray(ellipk(m))
    # A rate has the amplitude 2 sqrt(m w2).
    known = np.sqrt(m) * K if is_rate else np.sqrt(m)
    observed = amplitude * period / 8.0 if is_rate else np.sin(0.5 * min(amplitude, pi))
    root = 4.0 * float(np.interp(observed, known, K)) / period
    return root * root  # unlike a power, infinite instead of an error for a period of 1e-200 s
