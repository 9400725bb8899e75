"""Detection of the free swing in a recording, before the fit.

The turning points give a period and an amplitude. Polynomials over short windows give angle, rate
and acceleration. An acceleration that gravity and friction do not explain indicates a hand on the
pendulum. Rotations over the top are left out; the search continues after them.
"""

from dataclasses import replace
from math import pi
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import RecordingError
from equipoise.identification.averages import average, spikes
from equipoise.model.pendulum import PendulumParameters, swing
from equipoise.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SAMPLES_PER_PERIOD = 200
"""Number of means per period that replace a denser recording. A mean differs from the motion at its
centre by up to 1e-4 of the amplitude; the fit accounts for that."""
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
PERIOD_RANGE = (0.05, 20.0)
"""Accepted range of the period of a small swing [s]: point pendulums of 0.6 mm and 100 m. Periods
outside indicate a wrong unit, mostly milliseconds taken for seconds."""
MAX_AMPLITUDE = np.deg2rad(170.0)
"""Amplitude limit of a swing after a rotation over the top [rad]. Nearer to the top, w2 and
friction depend on the time that the pendulum lingers there, and a small error has a large
effect."""
MAX_NOISE = 0.1
"""Largest plausible noise of an encoder [rad] or of a gyro [rad/s]; more noise indicates a motion
that is sampled too slowly."""
MIN_MOTION = 1e-6
"""Smallest analysed motion [rad], of a gyro [rad/s]: no sensor resolves less."""
MIN_REVERSAL = 0.1
"""Smallest reversal that ends a rotation [rad]: well above an encoder's steps, well below a
swing."""
MAX_SWING_CHANGE = 0.05
"""Largest change of a swing across a disturbance that does not count as a touch, as a share of the
amplitude. The rough model is off by at most 2 % of the phase; a hand changes a swing by more."""
STATE_WINDOWS = (1 / 8, 1 / 4, 1 / 16)
"""Windows for estimating the first state, in periods of a small swing, the likeliest first. An
eighth of a period is short enough for a cubic. Coarse encoders need a longer window, the fastest
part of a large swing needs a shorter one."""


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


# Turning points.


def find_oscillation(trajectory: Trajectory) -> Oscillation:
    """Estimate period and amplitude from the turning points.

    Raises:
        RecordingError: There are too few samples, no oscillation above the noise, or less than one
            period.
    """
    time, values, name = trajectory.time, trajectory.values, trajectory.source
    unit = "rad/s" if trajectory.theta is None else "rad"
    least, several = MIN_SAMPLES_PER_PERIOD, "record at least three periods, better ten"
    if len(time) < 2 * least:
        raise RecordingError(
            f"{name} has {len(time)} samples, expected at least {2 * least:.0f}; {several}"
        )
    lasts = float(np.ptp(time))
    sampled = f"{(len(time) - 1) / lasts:.3g} samples per second"
    spread, noise = float(np.ptp(values)), _white_noise(values)
    quiet = max(1.5 * NOISE_MULTIPLE * noise, 4.0 * trajectory.resolution, MIN_MOTION)
    reversal = max(NOISE_MULTIPLE * noise, TURN_SHARE * spread)
    turns = _turning_points(values, max(reversal, 2.0 * trajectory.resolution))
    hardly = spread <= quiet or len(turns) < 2
    if hardly and (in_a_period := _samples_per_period(values)) < least:
        raise RecordingError(
            f"{name} is sampled too slowly: {sampled}, about {in_a_period:.1f} in a period, "
            f"expected {least:g} or more; sample faster"
        )
    if spread <= quiet and noise > MAX_NOISE:
        jump = float(np.median(np.abs(np.diff(values))))
        raise RecordingError(
            f"{name} is sampled too slowly, or holds nothing but noise: at {sampled} it moves by "
            f"{jump:.2g} {unit} from one to the next, expected {least:g} samples or more in a "
            "period; sample faster"
        )
    if spread <= quiet:
        raise RecordingError(
            f"{name} shows no oscillation above the noise: it varies by {spread:.3g} {unit}, "
            f"expected clearly more than its noise of {noise:.2g} {unit} and its sensor's step of "
            f"{trajectory.resolution:.2g} {unit}; release the pendulum from a larger angle"
        )
    if len(turns) < 2:
        raise RecordingError(
            f"{name} holds less than one period of a swing: in {lasts:.3g} s it turns round "
            f"{len(turns)} times; {several}"
        )
    period = 2.0 * float(np.median(np.diff(time[turns])))
    if lasts < period:
        raise RecordingError(
            f"{name} holds less than one period of a swing: it lasts {lasts:.3g} s, and a period "
            f"is about {period:.3g} s; {several}"
        )
    if (rate := len(time) * period / lasts) < least:
        raise RecordingError(
            f"{name} shows no oscillation above the noise, or is sampled too slowly: at {sampled} "
            f"it turns round every {0.5 * rate:.1f} samples, expected {0.5 * least:g} or more; "
            "sample faster, or release the pendulum from a larger angle"
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
            f"{PERIOD_RANGE[0]:g} to {PERIOD_RANGE[1]:g} s; is the time in seconds? Name its "
            "column time_ms or time_us where it is not"
        )
    return rough


def _samples_per_period(values: Array) -> float:
    """Return the number of samples per period at the dominant frequency, infinity without one."""
    n = len(values)
    power = np.abs(np.fft.rfft(values - np.mean(values))) ** 2
    peak = int(np.argmax(power))
    width = max(2, n // 50)
    near = power[max(peak - width, 1) : peak + width + 1]
    if peak == 0 or float(np.sum(near)) < 0.4 * float(np.sum(power[1:])):
        return float("inf")
    return n / peak


def _white_noise(values: Array) -> float:
    """Estimate the standard deviation of white noise on a smooth motion from third differences."""
    third = np.diff(values, 3)
    return float(1.4826 * np.median(np.abs(third - np.median(third))) / np.sqrt(20.0))


def _turning_points(values: Array, least: float) -> npt.NDArray[np.intp]:
    """Return the indices of turning points that a reversal of more than `least` follows."""
    turns: list[int] = []
    low = high = direction = 0
    places = _extremes(values)
    series = values[places].tolist()
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
    return places[[turn for turn in turns if turn > 0]]


def _extremes(values: Array) -> npt.NDArray[np.intp]:
    """Return the indices of candidate turning points: the extremes of blocks in long recordings."""
    n = len(values)
    size = n // 50_000
    if size < 4:
        return np.arange(n)
    end = n - n % size
    blocks, begins = values[:end].reshape(-1, size), np.arange(0, end, size)
    extremes = (begins + np.argmin(blocks, axis=1), begins + np.argmax(blocks, axis=1))
    return np.unique(np.concatenate(([0], *extremes, np.arange(end, n))))


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


def without_spikes(trajectory: Trajectory) -> tuple[Trajectory, list[str]]:
    """Remove single wrong samples; return the trajectory with warnings."""
    values, unit = trajectory.values, "deg/s" if trajectory.theta is None else "deg"
    if len(values) < 20:
        return trajectory, []
    wrong = spikes(values, _white_noise(values), trajectory.resolution)
    if not (n := int(np.count_nonzero(wrong))):
        return trajectory, []
    at = int(np.flatnonzero(wrong)[0])
    off = np.rad2deg(values[at] - np.median(values[max(at - 2, 0) : at + 3]))
    left_out = "a single sample is" if n == 1 else f"{n} single samples are"
    return _part(trajectory, ~wrong), [
        f"{left_out} left out: at {trajectory.time[at]:.3f} s the recording is {off:+.3g} {unit} "
        "off its neighbours; look at the sensor and its cable"
    ]


def _part(trajectory: Trajectory, kept: Flags) -> Trajectory:
    quantity = "theta" if trajectory.theta is not None else "theta_dot"
    kept_values: dict[str, Any] = {quantity: trajectory.values[kept]}
    return replace(trajectory, time=trajectory.time[kept], x_ddot=None, **kept_values)


def find_free_swing(trajectory: Trajectory) -> tuple[Oscillation, FreeSwing]:
    """Find the freely swinging part of a recording.

    Raises:
        RecordingError: No free swing lasts a period, or a unit is wrong.
    """
    until = _end_of_rotation(trajectory)
    over: float | None = None
    while True:
        try:
            if until is not None:
                over = until
                trajectory = _after_the_top(trajectory, until)
            rough = find_oscillation(trajectory)
            free = _find_free(trajectory, rough)
        except RecordingError:
            if over is None:
                raise
            raise RecordingError(
                f"{trajectory.source}: the pendulum goes over the top until {over:.2f} s, and no "
                "free swing of a period follows; expected a swing to and fro below the top: "
                "release it from a smaller angle, and record ten periods"
            ) from None
        if isinstance(free, FreeSwing):
            break
        until = free
    if over is not None:
        free.warnings.append(
            f"the pendulum goes over the top until {over:.2f} s: the recording is used from "
            f"{free.begin:.2f} s"
        )
    return rough, free


def _end_of_rotation(trajectory: Trajectory) -> float | None:
    """Return the end of the last rotation by a full turn [s], or None.

    Raises:
        RecordingError: The rotations alternate in direction, which no free pendulum does.
    """
    time = trajectory.time
    if len(time) < 20:
        return None
    angle, turns = _reversals(trajectory, time, trajectory.values)
    turns = np.concatenate(([0], turns, [len(time) - 1]))
    travel = np.abs(np.diff(angle[turns]))
    # The bias of a gyro adds to the travel of half a swing.
    slack = 0.5 if trajectory.theta is None else 0.0
    rotations = np.flatnonzero(travel >= 2.0 * pi + slack)
    if rotations.size >= 3 and np.any(np.diff(rotations, 2) == 0):
        largest = float(np.max(travel)) / 2.0
        unit = "are these degrees? Name the column theta_deg, or give counts --counts-per-rev"
        if trajectory.theta is None:
            unit = "is the rate in deg/s? Give it in rad/s"
        raise RecordingError(
            f"{trajectory.source}: the pendulum swings to and fro by {largest:.3g} rad, "
            f"{largest / (2.0 * pi):.1f} turns to each side, expected less than half a turn; {unit}"
        )
    return float(time[turns[rotations[-1] + 1]]) if rotations.size else None


def _reversals(
    trajectory: Trajectory, time: Array, angle: Array
) -> tuple[Array, npt.NDArray[np.intp]]:
    """Return an angle, or the integral of a rate [rad], with its clear turning points."""
    if trajectory.theta is None:
        steps = np.diff(time) * (angle[1:] + angle[:-1]) / 2.0
        angle = np.concatenate(([0.0], np.cumsum(steps)))
    noise = _white_noise(angle) if len(angle) >= 20 else 0.0
    least = max(MIN_REVERSAL, 8.0 * noise, 2.0 * trajectory.resolution)
    return angle, _turning_points(angle, least)


def _after_the_top(trajectory: Trajectory, until: float) -> Trajectory:
    """Return the recording after the last rotation, from an amplitude below `MAX_AMPLITUDE` on.

    Raises:
        RecordingError: Less than one period follows.
    """
    kept = trajectory.time > until
    time = trajectory.time[kept]
    angle, turns = _reversals(trajectory, time, trajectory.values[kept])
    if len(turns) < 2:
        raise RecordingError(f"{trajectory.source}: less than a period is left; record longer")
    amplitude = np.abs(np.diff(angle[turns])) / 2.0
    low = np.flatnonzero(amplitude < MAX_AMPLITUDE)
    if low.size and len(turns) - low[0] > 7:
        begin = time[turns[low[0] + 1]]
    else:
        # The hanging position lies in the middle between two turning points.
        middle = 0.5 * (angle[turns[0]] + angle[turns[1]])
        side = np.sign(angle[turns[0]] - middle)
        passed = np.flatnonzero(side * (angle[: turns[0]] - middle) < 0.0)
        begin = time[passed[-1]] if passed.size else time[turns[0]]
    return _part(trajectory, trajectory.time >= begin)


def _find_free(trajectory: Trajectory, rough: Oscillation) -> FreeSwing | float:
    """Return the free swing, or the end of a rotation over the top within it [s].

    Raises:
        RecordingError: The free swing is shorter than a period.
    """
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
        touched = _remove_false_touches(share > 1.0, motion, law, rough)
        moved = np.abs(law.theta_dot(motion.rate))
        begin, end = _longest_stretch(touched, moved)
        if begin > 0:
            first = min(int(np.searchsorted(time, motion.time[begin - 1] + half)), last)
            if _swings(~touched[:begin], moved[:begin], rough, half):
                warnings.append(_touch_warning(motion.time[begin - 1], time[first], "from"))
            elif float(np.max(share[:begin])) > 2.0:
                release = float(time[first])
        if end < len(touched):
            last = int(np.searchsorted(time, motion.time[end] - half)) - 1
            if float(np.max(share[end:])) > 2.0:
                warnings.append(_touch_warning(motion.time[end], time[max(last, 0)], "up to"))
    part = slice(first, last + 1)
    if (over := _last_over_the_top(time[part], values[part], theta[part], law)) is not None:
        return over
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
    return FreeSwing(
        begin=float(time[first] if first > 0 else trajectory.time[0]),
        end=float(time[last] if last < len(time) - 1 else trajectory.time[-1]),
        release=release,
        starts=_first_guesses(time[part], values[part], theta[part], law, rough),
        warnings=warnings,
    )


def _touch_warning(at: float, used: float, side: str) -> str:
    return (
        f"something touched the pendulum at about {at:.2f} s: the recording is used {side} "
        f"{used:.2f} s; choose another window with --start and --end"
    )


def _swings(free: Flags, moved: Array, rough: Oscillation, half: float) -> bool:
    """Return whether the pendulum swings freely for half a period at more than 20 % of its rate."""
    run = _longest_run(free)
    # Windows follow each other at a sixth of `half`.
    if run.stop - run.start < 3.0 * rough.period / half:
        return False
    return float(np.max(moved[run])) > 0.2 * float(np.sqrt(rough.w2)) * rough.amplitude


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


def _remove_false_touches(
    touched: Flags, motion: _Motion, law: _SwingLaw, rough: Oscillation
) -> Flags:
    """Return the touched windows without those that leave the swing unchanged.

    A hand changes the swing. If the model maps the motion before a suspected touch to the motion
    after it, a sample was wrong or a window barely exceeded the threshold.
    """
    places = np.flatnonzero(touched)
    # A wrong sample affects some of the windows that overlap it; a window spans twelve.
    groups = np.split(places, np.flatnonzero(np.diff(places) > 12) + 1) if places.size else []
    theta = law.theta(motion.angle, motion.elapsed)
    theta_dot = law.theta_dot(motion.rate)
    w, result = float(np.sqrt(law.w2)), touched.copy()
    model = PendulumParameters(law.w2, 0.0, law.c, law.coulomb)
    for group in groups:
        begin, end = int(group[0]), int(group[-1]) + 1
        if begin == 0 or end == len(touched):
            continue
        before, after = max(begin - 6, 0), min(end + 5, len(touched) - 1)
        times = motion.time[[before, after]]
        if times[1] - times[0] > rough.period:
            continue
        thetas, theta_dots = np.empty(2), np.empty(2)
        h = rough.period / 128.0
        swing(times, theta[before], theta_dot[before], h, model, thetas, theta_dots)
        off = np.hypot(thetas[1] - theta[after], (theta_dots[1] - theta_dot[after]) / w)
        size = np.hypot(2.0 * np.sin(0.5 * theta[after]), theta_dot[after] / w)
        if off < MAX_SWING_CHANGE * size:
            result[begin:end] = False
    return result


def _longest_stretch(touched: Flags, moved: Array) -> tuple[int, int]:
    """Return first and past-the-last window of the untouched stretch with the most motion."""
    edges = np.flatnonzero(touched)
    begins = np.concatenate(([0], edges + 1))
    ends = np.concatenate((edges, [len(touched)]))
    travel = np.concatenate(([0.0], np.cumsum(moved)))
    longest = int(np.argmax(travel[ends] - travel[begins]))
    return int(begins[longest]), int(ends[longest])


def _last_over_the_top(time: Array, values: Array, theta: Array, law: _SwingLaw) -> float | None:
    """Return the last time at which the pendulum goes over the top [s], or None."""
    if not law.is_rate:
        over = np.flatnonzero(np.abs(theta) >= pi)
        return float(time[over[-1]]) if over.size else None
    # The integral of a rate drifts, but not within a turn.
    falling = law.theta_dot(values) < 0.0
    turns = np.concatenate(([0], np.flatnonzero(np.diff(falling)), [len(time) - 1]))
    over = np.flatnonzero(np.abs(np.diff(theta[turns])) >= 2.0 * pi)
    return float(time[turns[over[-1] + 1]]) if over.size else None
