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
Flags = npt.NDArray[np.bool_]

SAMPLES_PER_PERIOD: Final = 200
"""Number of means per period that replace a denser recording. A mean differs from the motion at its
centre by up to 1e-4 of the amplitude; the fit accounts for that."""
PERIOD_RANGE: Final = (0.05, 20.0)
"""Accepted range of the period of a small swing [s]: point pendulums of 0.6 mm and 100 m. Periods
outside indicate a wrong unit, mostly milliseconds taken for seconds."""
MIN_MOTION: Final = 1e-6
"""Smallest analysed motion [rad], of a gyro [rad/s]: no sensor resolves less."""
STATE_WINDOWS: Final = (1 / 8, 1 / 4, 1 / 16)
"""Windows for estimating the first state, in periods of a small swing, the likeliest first. An
eighth of a period is short enough for a cubic. Coarse encoders need a longer window, the fastest
part of a large swing needs a shorter one."""
MIN_SAMPLES_PER_PERIOD: Final = 10.0
"""Minimum number of samples per period; with fewer, turning points are uncertain."""
NOISE_MULTIPLE: Final = 8.0
"""Minimum reversal after a turning point, in standard deviations of the noise: noise alone does
not reach it within the samples around a turn."""
TURN_SHARE: Final = 0.02
"""Minimum reversal after a turning point, as a share of the whole range, so that a tremor gives
no turning points."""
LOCAL_PERIODS: Final = 1 / 6
"""Half width of the windows of the local polynomials for angle, rate and acceleration, in
periods: wide enough for an encoder's steps, narrow enough to detect a release."""
RELEASE_SHARE: Final = 0.25
"""Share of the nearby peak acceleration that gravity and friction do not explain, above which a
hand is on the pendulum. On recorded swings, hands showed 0.5 and more, errors of the time
stamps up to 0.18."""
RELEASE_NOISE: Final = 5.0
"""Second threshold for a hand, in standard deviations of the unexplained acceleration of a free
swing; both must be exceeded."""
REST_SHARE: Final = 0.02
"""Share of the maximum amplitude at which the swing ends: stiction dominates the rest."""


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

    @property
    def small_period(self) -> float:
        """Period of a small swing [s]."""
        return 2.0 * pi / float(np.sqrt(self.w2))


class FreeSwing(NamedTuple):
    """The freely swinging part of a recording, with initial guesses for its fit."""

    begin: float
    """Time of its first sample [s]."""
    end: float
    """Time of its last sample [s]."""
    release: float | None
    """Time of the release by a hand [s]; None if unknown."""
    starts: list[Array]
    """Initial guesses of w2, c, Coulomb friction, drag, angle and rate at `begin`, and offset;
    shape (7,) each, the likeliest first."""
    warnings: list[str]
    """Warnings about excluded parts of the recording, with the reasons."""


class Averages(NamedTuple):
    """Means over bins of equal length in time; empty bins are left out."""

    time: Array
    """Mean time of the samples in each bin [s], shape (n,)."""
    values: Array
    """Mean value of the samples in each bin, in the recording's unit, shape (n,)."""
    spread: Array
    """Standard deviation of the times in each bin [s], shape (n,); zero for a single sample."""


def average(time: Array, values: Array, width: float) -> Averages:
    """Return the means of samples over bins.

    Means over a fraction of a degree of the motion carry as much information about a pendulum as
    millions of samples; the white noise averages out in both. With fewer than two samples per bin,
    the samples are returned unchanged.

    Args:
        time: Time stamps [s], increasing, shape (n,).
        values: Recorded values, shape (n,).
        width: Length of the bins [s].
    """
    elapsed = time - time[0]
    bins = np.floor(elapsed / width)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    count = np.diff(first, append=len(time)).astype(np.float64)
    if len(time) < 2 * len(first):
        return Averages(time, values, np.zeros_like(time))
    middle = np.add.reduceat(elapsed, first) / count
    squares = (elapsed - np.repeat(middle, count.astype(np.intp))) ** 2
    return Averages(
        time[0] + middle,
        np.add.reduceat(values, first) / count,
        np.sqrt(np.add.reduceat(squares, first) / count),
    )


# Turning points.


def find_oscillation(trajectory: Trajectory) -> Oscillation:
    """Estimate period and amplitude from the turning points.

    Raises:
        RecordingError: There are too few samples, no oscillation above the noise, or less than one
            period; or a unit is wrong.
    """
    time, values, name = trajectory.time, trajectory.values, trajectory.source
    lasts, spread = float(np.ptp(time)), float(np.ptp(values))
    found = f"{len(time)} samples in {lasts:.3g} s that vary by {spread:.3g} rad, or rad/s"
    advice = (
        "; release the pendulum from 40 to 60 deg, record ten periods with at least "
        f"{MIN_SAMPLES_PER_PERIOD:g} samples in each, and give the unit in the column's name"
    )
    if trajectory.theta is not None and spread >= 2.0 * pi:
        raise RecordingError(
            f"{name} goes over the top: {found}, expected a swing below it{advice}"
        )
    enough = len(time) >= 2 * MIN_SAMPLES_PER_PERIOD
    noise = _white_noise(values) if enough else 0.0
    reversal = max(NOISE_MULTIPLE * noise, TURN_SHARE * spread, 2.0 * trajectory.resolution)
    turns = _turning_points(values, reversal)
    quiet = max(1.5 * NOISE_MULTIPLE * noise, 4.0 * trajectory.resolution, MIN_MOTION)
    if not enough or spread <= quiet or len(turns) < 2:
        raise RecordingError(
            f"{name} shows no oscillation: {found}, with noise of {noise:.2g} and {len(turns)} "
            f"turning points{advice}"
        )
    period = 2.0 * float(np.median(np.diff(time[turns])))
    if lasts < period or len(time) * period / lasts < MIN_SAMPLES_PER_PERIOD:
        raise RecordingError(
            f"{name} holds less than one period, or too few samples in each: {found}, with a "
            f"period of about {period:.3g} s{advice}"
        )
    spacing = np.diff(time[turns]) / (0.5 * period)
    run = _longest_run((spacing > 0.6) & (spacing < 1.6))
    turns = turns[run.start : run.stop + 1]
    begin, end = float(time[turns[0]]), float(time[turns[-1]])
    margin = max(0.5 * (period - (end - begin)), 0.0)
    ends = values[turns]
    middle = float(np.median(ends[1:] + ends[:-1])) / 2.0
    amplitude = float(np.median(np.abs(np.diff(ends)))) / 2.0
    w2 = _w2_from_period(period, amplitude, trajectory.theta is None)
    rough = Oscillation(period, middle, amplitude, (begin - margin, end + margin), w2)
    if not PERIOD_RANGE[0] <= rough.small_period <= PERIOD_RANGE[1]:
        raise RecordingError(
            f"{name}: a small swing would have a period of {rough.small_period:.3g} s, expected "
            f"{PERIOD_RANGE[0]:g} to {PERIOD_RANGE[1]:g} s{advice}"
        )
    return rough


def _white_noise(values: Array) -> float:
    """Estimate the standard deviation of white noise on a smooth motion from third differences."""
    third = np.diff(values, 3)
    return float(1.4826 * np.median(np.abs(third - np.median(third))) / np.sqrt(20.0))


def _turning_points(values: Array, least: float) -> npt.NDArray[np.intp]:
    """Return the indices of turning points that a reversal of more than `least` follows."""
    turns: list[int] = []
    low = high = direction = 0
    series = values.tolist()
    for i, value in enumerate(series):
        if value > series[high]:
            high = i
        if value < series[low]:
            low = i
        if direction >= 0 and series[high] - value > least:
            turns.append(high)
            direction, low, high = -1, i, i
        elif direction <= 0 and value - series[low] > least:
            turns.append(low)
            direction, low, high = 1, i, i
    # The first sample of a recording is no turning point.
    return np.array([turn for turn in turns if turn > 0], np.intp)


def _longest_run(flags: Flags) -> slice:
    """Return the longest run of set flags; empty if no flag is set."""
    edges = np.flatnonzero(np.concatenate(([True], ~flags, [True])))
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]) - 1)


# The free swing.


class _Motion(NamedTuple):
    """Motion at the centres of short windows, shape (m,) each."""

    time: Array
    """Time stamps [s]."""
    elapsed: Array
    """Time since the first sample [s]."""
    angle: Array
    """Recorded angle, or the integral of the recorded rate [rad]."""
    rate: Array
    """Derivative of the angle, or the recorded rate [rad/s]."""
    acceleration: Array
    """Derivative of the rate [rad/s^2]."""


class _SwingLaw(NamedTuple):
    """Equation of the swing with rough parameters."""

    w2: float
    offset: float
    c: float
    coulomb: float
    anchor: float
    """Angle at the first sample [rad], the integration constant of a recorded rate."""
    slow: float
    """Rate below which dry friction changes sign smoothly [rad/s]."""
    is_rate: bool

    def theta(self, angle: Array, elapsed: Array) -> Array:
        """Return the angle from hanging [rad]."""
        return angle - self.offset * elapsed + self.anchor if self.is_rate else angle - self.offset

    def theta_dot(self, rate: Array) -> Array:
        """Return the true rate [rad/s]."""
        return rate - self.offset if self.is_rate else rate

    def unexplained(self, motion: _Motion) -> Array:
        """Return the acceleration that gravity and friction do not explain [rad/s^2]."""
        theta_dot = self.theta_dot(motion.rate)
        friction = self.c * theta_dot + self.coulomb * np.tanh(theta_dot / self.slow)
        gravity = self.w2 * np.sin(self.theta(motion.angle, motion.elapsed))
        return motion.acceleration + gravity + friction


def find_free_swing(trajectory: Trajectory) -> tuple[Oscillation, FreeSwing]:
    """Find the freely swinging part of a recording.

    Raises:
        RecordingError: No free swing lasts a period, or a unit is wrong.
    """
    rough = find_oscillation(trajectory)
    name, is_rate, warnings = trajectory.source, trajectory.theta is None, list[str]()
    time, values, _ = average(trajectory.time, trajectory.values, rough.period / SAMPLES_PER_PERIOD)
    # A window holds at least seven samples. A large swing has a long period, but passes the bottom
    # as fast as a small one.
    step = float(np.median(np.diff(time)))
    half = max(LOCAL_PERIODS * min(rough.period, rough.small_period), 3.2 * step)
    angle = _angle(time, values) if is_rate else values
    motion = _local_motion(time, values, angle, half, is_rate)
    if len(motion.time) < 4:
        raise RecordingError(
            f"{name} has too many gaps in its time stamps: expected at least 5 samples in every "
            f"{2.0 * half:.3g} s; sample faster"
        )
    steady = (motion.time >= rough.steady[0]) & (motion.time <= rough.steady[1])
    if np.count_nonzero(steady) < 8:
        steady[:] = True
    law = _fit_rough_model(_Motion(*(series[steady] for series in motion)), rough, is_rate)
    theta = law.theta(angle, time - time[0])
    first, last, release = 0, len(time) - 1, None
    if not trajectory.released:
        share = _unexplained_share(motion, law, steady, rough.period)
        touched = share > 1.0
        begin, end = _longest_stretch(touched, np.abs(law.theta_dot(motion.rate)))
        if begin > 0:
            first = min(int(np.searchsorted(time, motion.time[begin - 1] + half)), last)
            release = float(time[first]) if np.max(share[:begin]) > 2.0 else None
        if end < len(touched):
            last = int(np.searchsorted(time, motion.time[end] - half)) - 1
            if np.max(share[end:]) > 2.0:
                warnings.append(
                    f"something touched the pendulum at about {motion.time[end]:.2f} s: the "
                    "recording is used up to there; choose another window with --start and --end"
                )
    part = slice(first, last + 1)
    if last > first:
        size = np.abs(theta[part])
        moving = time[part][size > REST_SHARE * np.max(size)][-1]
        last = min(last, int(np.searchsorted(time, moving + 0.5 * rough.period)))
        part = slice(first, last + 1)
    if (lasts := float(time[last] - time[first]) if last > first else 0.0) < rough.period:
        raise RecordingError(
            f"{name} holds less than one period of a free swing: it is free for {lasts:.3g} s, and "
            f"a period is about {rough.period:.3g} s; record at least three periods after the hand "
            "lets go"
        )
    return rough, FreeSwing(
        begin=float(time[first] if first > 0 else trajectory.time[0]),
        end=float(time[last] if last < len(time) - 1 else trajectory.time[-1]),
        release=release,
        starts=_first_guesses(time[part], values[part], theta[part], law, rough),
        warnings=warnings,
    )


def _first_guesses(
    time: Array, values: Array, theta: Array, law: _SwingLaw, rough: Oscillation
) -> list[Array]:
    """Return initial guesses of the unknowns, the likeliest first; shape (7,) each."""
    starts: list[Array] = []
    for w2, share in [*((law.w2, share) for share in STATE_WINDOWS), (rough.w2, STATE_WINDOWS[0])]:
        window = share * 2.0 * pi / float(np.sqrt(w2))
        near = slice(max(int(np.searchsorted(time, time[0] + window)), 7))
        elapsed = time[near] - time[0]
        powers = np.vander(elapsed / elapsed[-1], 4, increasing=True)
        value, slope = np.linalg.lstsq(powers, values[near], rcond=None)[0][:2]
        angle = float(theta[0] if law.is_rate else value - law.offset)
        rate = float(value - law.offset if law.is_rate else slope / elapsed[-1])
        # A faster pendulum would go over the top, and the fit would begin with a rotation.
        fastest = 0.99 * 2.0 * float(np.sqrt(w2)) * abs(float(np.cos(0.5 * angle)))
        rate = min(max(rate, -fastest), fastest)
        starts.append(np.array([w2, law.c, 0.0, 0.0, angle, rate, law.offset]))
    return starts


def _angle(time: Array, rate: Array) -> Array:
    """Return the integral of a recorded rate [rad]."""
    from scipy.interpolate import CubicSpline

    elapsed = time - time[0]
    return np.asarray(CubicSpline(elapsed, rate).antiderivative()(elapsed))


def _local_motion(time: Array, values: Array, angle: Array, half: float, is_rate: bool) -> _Motion:
    """Compute angle, rate and acceleration in windows of half width `half` [s]."""
    centres = np.arange(time[0] + half, time[-1] - half, half / 6.0)
    # Batches of windows limit the size of the arrays.
    batches = np.split(centres, range(512, len(centres), 512))
    found = np.concatenate([_polynomials(time, values, batch, half) for batch in batches])
    found /= half ** np.arange(3)
    good = np.isfinite(found[:, 0])
    centres, found = centres[good], found[good]
    elapsed = centres - time[0]
    if not is_rate:
        return _Motion(centres, elapsed, found[:, 0], found[:, 1], found[:, 2])
    return _Motion(centres, elapsed, np.interp(centres, time, angle), found[:, 0], found[:, 1])


def _polynomials(time: Array, values: Array, centres: Array, half: float) -> Array:
    """Return value, slope and curvature at the centres of windows, shape (m, 3).

    Fits polynomials of fourth order, of third order to fewer than seven samples; returns NaN for
    windows with fewer than five samples or with a gap.
    """
    low = np.searchsorted(time, centres - half)
    high = np.searchsorted(time, centres + half, side="right")
    count = high - low
    places = low[:, np.newaxis] + np.arange(int(np.max(count, initial=0)))
    inside = places < high[:, np.newaxis]
    places = np.minimum(places, len(time) - 1)
    s = np.where(inside, (time[places] - centres[:, np.newaxis]) / half, 1.0)
    gap = np.max(np.diff(s, axis=1, prepend=-1.0, append=1.0), axis=1)
    found = np.full((len(centres), 3), np.nan)
    middle = values[np.minimum(low, len(time) - 1)]
    for terms, chosen in ((5, count >= 7), (4, (count >= 5) & (count < 7))):
        good = chosen & (gap <= 0.7)
        if not np.any(good):
            continue
        powers = np.empty((int(np.count_nonzero(good)), terms, s.shape[1]))
        powers[:, 0] = inside[good]
        for i in range(1, terms):
            np.multiply(powers[:, i - 1], s[good], out=powers[:, i])
        change = values[places[good]] - middle[good, np.newaxis]
        moments = powers @ powers.transpose(0, 2, 1)
        right = powers @ change[..., np.newaxis]
        solved = np.linalg.solve(moments, right)[:, :3, 0]
        found[good] = solved * (1.0, 1.0, 2.0)
        found[good, 0] += middle[good]
    return found


def _fit_rough_model(motion: _Motion, rough: Oscillation, is_rate: bool) -> _SwingLaw:
    """Fit the equation to the accelerations with a loss that is robust against outliers."""
    from scipy.optimize import least_squares

    w2 = rough.w2
    theta_dot = motion.rate - rough.middle if is_rate else motion.rate
    slow = 0.05 * float(np.quantile(np.abs(theta_dot), 0.9))
    size = float(np.quantile(np.abs(motion.acceleration), 0.9))
    # A recorded angle needs no integration constant.
    n = 5 if is_rate else 4
    anchor = -float(np.median(motion.angle - rough.middle * motion.elapsed)) if is_rate else 0.0
    guess = np.array([w2, rough.middle, 0.01 * np.sqrt(w2), 1e-3 * size, anchor])
    low = np.array([0.25 * w2, -np.inf, 0.0, 0.0, -np.inf])
    high = np.array([4.0 * w2, np.inf, np.inf, np.inf, np.inf])
    scales = np.array([w2, rough.amplitude, np.sqrt(w2), size, 1.0])

    def law(x: Array) -> _SwingLaw:
        return _SwingLaw(*np.append(x, anchor)[:5].tolist(), slow=slow, is_rate=is_rate)

    solution = least_squares(
        lambda x: law(x).unexplained(motion) / size,
        guess[:n],
        bounds=(low[:n], high[:n]),
        x_scale=scales[:n],
        loss="cauchy",
        f_scale=0.03,
    )
    return law(solution.x)


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


def _unexplained_share(motion: _Motion, law: _SwingLaw, steady: Flags, period: float) -> Array:
    """Return the ratio of the unexplained acceleration to the threshold of a touch."""
    unexplained = np.abs(law.unexplained(motion))
    # 0.6745 is the median of |N(0, 1)|.
    noise = float(np.median(unexplained[steady])) / 0.6745
    pull = law.w2 * np.abs(np.sin(law.theta(motion.angle, motion.elapsed)))
    low = np.searchsorted(motion.time, motion.time - 0.5 * period)
    high = np.searchsorted(motion.time, motion.time + 0.5 * period, side="right")
    peak = np.array([np.max(pull[a:b]) for a, b in zip(low, high, strict=True)])
    limit = np.maximum(RELEASE_SHARE * peak, RELEASE_NOISE * noise)
    return unexplained / np.maximum(limit, 1e-300)


def _longest_stretch(touched: Flags, moved: Array) -> tuple[int, int]:
    """Return first and past-the-last window of the untouched stretch with the most motion."""
    edges = np.flatnonzero(touched)
    begins = np.concatenate(([0], edges + 1))
    ends = np.concatenate((edges, [len(touched)]))
    travel = np.concatenate(([0.0], np.cumsum(moved)))
    longest = int(np.argmax(travel[ends] - travel[begins]))
    return int(begins[longest]), int(ends[longest])
