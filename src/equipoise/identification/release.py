"""Detection of the free swing in a recording, before the fit.

The turning points give a period and an amplitude. Polynomials over short windows give angle, rate
and acceleration. An acceleration that gravity and friction do not explain indicates a hand on the
pendulum.
"""

from math import pi
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory

Array = npt.NDArray[np.float64]

PERIOD_RANGE: Final = (0.05, 20.0)
"""Accepted range of the period of a small swing [s]: point pendulums of 0.6 mm and 100 m. Periods
outside indicate a wrong unit, mostly milliseconds taken for seconds."""
MIN_SAMPLES_PER_PERIOD: Final = 10.0
"""Minimum number of samples per period; with fewer, turning points are uncertain."""
NOISE_MULTIPLE: Final = 8.0
"""Minimum reversal after a turning point, in standard deviations of the noise: noise alone does
not reach it within the samples around a turn."""
RELEASE_SHARE: Final = 0.25
"""Share of the nearby peak acceleration that gravity and friction do not explain, above which a
hand is on the pendulum. On recorded swings, hands showed 0.5 and more, errors of the time
stamps up to 0.18."""
RELEASE_NOISE: Final = 5.0
"""Second threshold for a hand, in standard deviations of the unexplained acceleration of a free
swing; both must be exceeded."""


class Oscillation(NamedTuple):
    """Period and amplitude of a swing, from its turning points."""

    period: float
    """Period of the swing at its own amplitude [s]."""
    middle: float
    """Centre between turning points, in the recording's unit."""
    amplitude: float
    """Half the median distance between turning points, in the recording's unit."""
    steady: tuple[float, float]
    """Begin and end of the interval with regularly spaced turning points [s]."""
    w2: float
    """Gravity over inertia, from period and amplitude [1/s^2]."""


class FreeSwing(NamedTuple):
    """The freely swinging part of a recording, with initial guesses for its fit."""

    period: float
    """Period of the swing [s]."""
    part: slice
    """Its samples."""
    release: float | None
    """Time of the release by a hand [s]; None if unknown."""
    starts: list[Array]
    """Initial guesses of w2, c, Coulomb friction, drag, angle and rate at the first sample, and
    offset; shape (7,) each, the likeliest first."""
    warnings: list[str]
    """Warnings about excluded parts of the recording, with the reasons."""


def find_oscillation(trajectory: Trajectory) -> Oscillation:
    """Estimate period and amplitude from the turning points.

    Raises:
        RecordingError: There are too few samples, no oscillation above the noise, or less than one
            period; or a unit is wrong.
    """
    from scipy.signal import find_peaks

    time, values = trajectory.time, trajectory.values
    lasts, spread = float(np.ptp(time)), float(np.ptp(values))

    def refusal(fault: str) -> RecordingError:
        return RecordingError(
            f"{trajectory.source} {fault}: {len(time)} samples in {lasts:.3g} s that vary by "
            f"{spread:.3g} rad, or rad/s; release the pendulum from 40 to 60 deg, record ten "
            f"periods with at least {MIN_SAMPLES_PER_PERIOD:g} samples in each, and give the unit "
            "in the column's name"
        )

    if trajectory.theta is not None and spread >= 2.0 * pi:
        raise refusal("goes over the top")
    if len(time) < 2 * MIN_SAMPLES_PER_PERIOD:
        raise refusal("holds too few samples")
    third = np.diff(values, 3)  # of a smooth motion almost noise alone
    noise = 1.4826 * float(np.median(np.abs(third - np.median(third)))) / np.sqrt(20.0)
    # A tremor of 2 % of the range gives no turning points. No sensor resolves less than 1e-6.
    reversal = max(NOISE_MULTIPLE * noise, 0.02 * spread, 2.5 * trajectory.resolution)
    first = 1e-6 * spread * np.linspace(1.0, 0.0, len(values))  # of equal values at a turn
    peaks = [find_peaks(sign * values + first, prominence=reversal)[0] for sign in (1.0, -1.0)]
    turns = np.sort(np.concatenate(peaks))
    quiet = max(1.5 * NOISE_MULTIPLE * noise, 4.0 * trajectory.resolution, 1e-6)
    if spread <= quiet or len(turns) < 2:
        raise refusal("shows no oscillation")
    period = 2.0 * float(np.median(np.diff(time[turns])))
    spacing = np.diff(time[turns]) / (0.5 * period)
    edges = np.flatnonzero(np.concatenate(([True], (spacing < 0.6) | (spacing > 1.6), [True])))
    longest = int(np.argmax(np.diff(edges)))
    turns = turns[edges[longest] : edges[longest + 1]]
    too_few = len(turns) < 2 or len(time) * period / lasts < MIN_SAMPLES_PER_PERIOD
    if too_few or lasts < period:
        raise refusal(f"holds less than one period of {period:.3g} s, or too few samples in each")
    begin, end = float(time[turns[0]]), float(time[turns[-1]])
    margin = max(0.5 * (period - (end - begin)), 0.0)
    ends = values[turns]
    middle = float(np.median(ends[1:] + ends[:-1])) / 2.0
    amplitude = float(np.median(np.abs(np.diff(ends)))) / 2.0
    w2 = _w2_from_period(period, amplitude, trajectory.theta is None)
    if not PERIOD_RANGE[0] <= 2.0 * pi / np.sqrt(w2) <= PERIOD_RANGE[1]:
        raise refusal(f"has a period of {period:.3g} s, expected {PERIOD_RANGE} s")
    return Oscillation(period, middle, amplitude, (begin - margin, end + margin), w2)


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


def find_free_swing(trajectory: Trajectory) -> FreeSwing:
    """Find the freely swinging part of a recording.

    Raises:
        RecordingError: No free swing lasts a period, or a unit is wrong.
    """
    rough, warnings = find_oscillation(trajectory), list[str]()
    time, values, is_rate = trajectory.time, trajectory.values, trajectory.theta is None
    half, motion = _smoothed(time, values, rough, is_rate)
    at = motion[0] + time[0]
    if len(at) < 4:
        raise RecordingError(
            f"{trajectory.source} has too many gaps in its time stamps: expected at least 5 "
            f"samples in every {2.0 * half:.3g} s; sample faster"
        )
    steady = (at >= rough.steady[0]) & (at <= rough.steady[1])
    if np.count_nonzero(steady) < 8:
        steady[:] = True
    law = _fit_rough_law(motion[:, steady], rough, is_rate)
    w2, _, _, zero, bias = law
    first, last, release = 0, len(time) - 1, None
    if not trajectory.released:
        unexplained = np.abs(_unexplained(law, motion))
        noise = float(np.median(unexplained[steady])) / 0.6745  # the median of |N(0, 1)|
        pull = w2 * np.abs(np.sin(motion[1] - zero - bias * motion[0]))
        low = np.searchsorted(at, at - 0.5 * rough.period)
        high = np.searchsorted(at, at + 0.5 * rough.period, side="right")
        peak = np.array([np.max(pull[a:b]) for a, b in zip(low, high, strict=True)])
        share = unexplained / np.maximum(RELEASE_SHARE * peak, RELEASE_NOISE * noise)
        # The untouched stretch with the most motion.
        touched = np.flatnonzero(share > 1.0)
        begins, ends = np.append(0, touched + 1), np.append(touched, len(share))
        travel = np.append(0.0, np.cumsum(np.abs(motion[2] - bias)))
        longest = int(np.argmax(travel[ends] - travel[begins]))
        begin, end = int(begins[longest]), int(ends[longest])
        if begin > 0:
            first = min(int(np.searchsorted(time, at[begin - 1] + half)), last)
            release = float(time[first]) if np.max(share[:begin]) > 2.0 else None
        if end < len(share):
            last = int(np.searchsorted(time, at[end] - half)) - 1
            if np.max(share[end:]) > 2.0:
                warnings.append(
                    f"something touched the pendulum at about {at[end]:.2f} s: the recording is "
                    "used up to there; choose another window with --start and --end"
                )
    angle = _integral(time, values) if is_rate else values
    theta = angle - zero - bias * (time - time[0])
    size = np.abs(theta[first : last + 1])
    if len(size):  # stiction dominates where less than 2 % of the amplitude is left
        moving = time[first : last + 1][size > 0.02 * np.max(size)][-1]
        last = min(last, int(np.searchsorted(time, moving + 0.5 * rough.period)))
    if (lasts := float(time[last] - time[first]) if last > first else 0.0) < rough.period:
        raise RecordingError(
            f"{trajectory.source} holds less than one period of a free swing: it is free for "
            f"{lasts:.3g} s, and a period is about {rough.period:.3g} s; record at least three "
            "periods after the hand lets go"
        )
    part = slice(first, last + 1)
    starts = _first_guesses(time[part], values[part], theta[part], law, rough, is_rate)
    return FreeSwing(rough.period, part, release, starts, warnings)


def _integral(time: Array, rate: Array) -> Array:
    """Return the angle from the first sample of a recorded rate [rad]."""
    from scipy.interpolate import CubicSpline

    elapsed = time - time[0]
    return np.asarray(CubicSpline(elapsed, rate).antiderivative()(elapsed))


def _smoothed(time: Array, values: Array, rough: Oscillation, is_rate: bool) -> tuple[float, Array]:
    """Fit polynomials of fourth order to windows; leave windows with a gap out.

    Returns:
        The half width of the windows [s], and at their centres the time since the first sample [s],
        the recorded angle or the integral of the recorded rate [rad], its rate [rad/s] and its
        acceleration [rad/s^2], shape (4, m).
    """
    from scipy.ndimage import maximum_filter1d
    from scipy.signal import savgol_filter

    elapsed = time - time[0]
    step = float(np.median(np.diff(elapsed)))
    # Wide enough for an encoder's steps, narrow enough to detect a release. A large swing has a
    # long period, but passes the bottom as fast as a small one.
    half = max(min(rough.period, 2.0 * pi / float(np.sqrt(rough.w2))) / 6.0, 3.2 * step)
    reach = int(half / step)
    grid = np.arange(0.0, elapsed[-1], step)
    even = np.interp(grid, elapsed, values)
    smooth: list[Array] = [
        np.asarray(savgol_filter(even, 2 * reach + 1, 4, order, step)) for order in range(3)
    ]
    if is_rate:
        smooth = [np.interp(grid, elapsed, _integral(time, values)), *smooth[:2]]
    steps = np.diff(elapsed)[np.searchsorted(elapsed, grid, side="right") - 1]
    gap = maximum_filter1d(steps, 2 * reach + 1) > 0.7 * half
    centres = np.arange(reach, len(grid) - reach, max(reach // 6, 1))
    return half, np.stack([grid, *smooth])[:, centres[~gap[centres]]]


def _unexplained(law: Array, motion: Array) -> Array:
    """Return the acceleration that gravity and friction do not explain [rad/s^2].

    Args:
        law: w2, c, Coulomb friction, angle at rest and bias of the rate, shape (5,).
        motion: Time, angle, rate and acceleration, see `_smoothed`.
    """
    w2, c, coulomb, zero, bias = law
    elapsed, angle, rate, acceleration = motion
    theta_dot = rate - bias
    # Dry friction changes its sign smoothly at low rates.
    slow = 0.05 * np.quantile(np.abs(theta_dot), 0.9)
    friction = c * theta_dot + coulomb * np.tanh(theta_dot / slow)
    return acceleration + w2 * np.sin(angle - zero - bias * elapsed) + friction


def _fit_rough_law(motion: Array, rough: Oscillation, is_rate: bool) -> Array:
    """Fit the equation to the accelerations with a loss that is robust against outliers."""
    from scipy.optimize import least_squares

    w2 = rough.w2
    size = float(np.quantile(np.abs(motion[3]), 0.9))
    bias = rough.middle if is_rate else 0.0
    zero = float(np.median(motion[1] - bias * motion[0])) if is_rate else rough.middle
    # A recorded angle has no bias.
    n = 5 if is_rate else 4
    guess = np.array([w2, 0.01 * np.sqrt(w2), 1e-3 * size, zero, bias])
    scales = np.array([w2, np.sqrt(w2), size, 1.0, rough.amplitude])
    low = np.array([0.25 * w2, 0.0, 0.0, -np.inf, -np.inf])
    high = np.array([4.0 * w2, np.inf, np.inf, np.inf, np.inf])
    solution = least_squares(
        lambda x: _unexplained(np.append(x, guess[n:]), motion) / size,
        guess[:n],
        bounds=(low[:n], high[:n]),
        x_scale=scales[:n],
        loss="cauchy",
        f_scale=0.03,
    )
    return np.append(solution.x, guess[n:])


def _first_guesses(
    time: Array, values: Array, theta: Array, law: Array, rough: Oscillation, is_rate: bool
) -> list[Array]:
    """Return initial guesses of the unknowns, the likeliest first; shape (7,) each."""
    starts: list[Array] = []
    w2, c, _, zero, bias = law
    offset = bias if is_rate else zero
    # A cubic over an eighth of a period gives the first state. Coarse encoders need a longer
    # window, the fastest part of a large swing needs a shorter one.
    for guess, share in ((w2, 1 / 8), (w2, 1 / 4), (w2, 1 / 16), (rough.w2, 1 / 8)):
        window = share * 2.0 * pi / float(np.sqrt(guess))
        near = slice(max(int(np.searchsorted(time, time[0] + window)), 7))
        elapsed = time[near] - time[0]
        powers = np.vander(elapsed / elapsed[-1], 4, increasing=True)
        value, slope = np.linalg.lstsq(powers, values[near], rcond=None)[0][:2]
        angle = float(theta[0] if is_rate else value - offset)
        rate = float(value - offset if is_rate else slope / elapsed[-1])
        # A faster pendulum would go over the top, and the fit would begin with a rotation.
        fastest = 0.99 * 2.0 * float(np.sqrt(guess)) * abs(float(np.cos(0.5 * angle)))
        rate = min(max(rate, -fastest), fastest)
        starts.append(np.array([guess, c, 0.0, 0.0, angle, rate, offset]))
    return starts
