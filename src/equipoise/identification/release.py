"""Where a recording swings freely, before anything is fitted to it.

The turning points give a period and an amplitude. Polynomials over short windows give angle, rate
and acceleration; where gravity and friction do not explain the acceleration, a hand is on the
pendulum.
"""

from math import ceil, pi
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import RecordingError
from equipoise.settings import IdentificationSettings
from equipoise.trajectory import Trajectory

Array = npt.NDArray[np.float64]


class Oscillation(NamedTuple):
    """What the turning points tell."""

    period: float
    """Period of the swing at its own amplitude [s]."""
    middle: float
    """Middle between turning points, in the recording's unit."""
    amplitude: float
    """Half the median distance between turning points, in the recording's unit."""
    steady: tuple[float, float]
    """From when to when the turning points follow each other as those of a swing do [s]."""


class FreeSwing(NamedTuple):
    """The part of a recording that swings freely, and a first guess at its law."""

    keep: slice
    """Its samples."""
    release: float | None
    """Time from which the swing was found to be free [s]; none where all before it is, too."""
    w2: float
    """Gravity over inertia [1/s^2]."""
    c: float
    """Viscous friction over inertia [1/s]."""
    theta: float
    """Angle from hanging at its first sample [rad]."""
    theta_dot: float
    """Its rate [rad/s]."""
    offset: float
    """Recorded minus true: zero offset [rad], or bias of the gyro [rad/s]."""
    warnings: list[str]
    """What was left out at the end, and why."""


# Turning points.


def find_oscillation(trajectory: Trajectory, settings: IdentificationSettings) -> Oscillation:
    """Find period and amplitude from the turning points.

    Raises:
        RecordingError: Too few samples, no oscillation above the noise, or less than a period.
    """
    time, values, name = trajectory.time, trajectory.values, trajectory.source
    unit = "rad/s" if trajectory.theta is None else "rad"
    if len(time) < 2 * settings.samples_per_period:
        raise RecordingError(
            f"{name} has {len(time)} samples, expected at least "
            f"{2 * settings.samples_per_period:.0f}; record a swing of a few periods"
        )
    spread, noise = float(np.ptp(values)), _white_noise(values)
    quiet = max(1.5 * settings.noise_multiple * noise, 4.0 * trajectory.resolution)
    if spread <= quiet:
        raise RecordingError(
            f"{name} shows no oscillation above the noise: it varies by {spread:.3g} {unit}, "
            f"expected more than {quiet:.3g} {unit} with its noise and sensor steps; "
            "release the pendulum from a larger angle"
        )
    least = max(settings.noise_multiple * noise, settings.turn_share * spread)
    turns = _turning_points(values, max(least, 2.0 * trajectory.resolution))
    if len(turns) < 2 and trajectory.theta is not None and spread > 2.0 * pi:
        raise _over_the_top(name, float(time[-1]))
    lasts = float(np.ptp(time))
    if len(turns) < 2:
        raise RecordingError(
            f"{name} holds less than one period of a swing: in {lasts:.3g} s it turns round "
            f"{len(turns)} times; record at least three periods, better ten"
        )
    period = 2.0 * float(np.median(np.diff(time[turns])))
    if lasts < period:
        raise RecordingError(
            f"{name} holds less than one period of a swing: it lasts {lasts:.3g} s, and a period "
            f"is about {period:.3g} s; record at least three periods, better ten"
        )
    if (rate := len(time) * period / lasts) < settings.samples_per_period:
        raise RecordingError(
            f"{name} shows no oscillation above the noise, or is sampled too slowly: it turns "
            f"round every {0.5 * rate:.1f} samples, expected {0.5 * settings.samples_per_period:g} "
            "or more; sample faster, or release the pendulum from a larger angle"
        )
    turns = turns[_steady_run(np.diff(time[turns]) / (0.5 * period))]
    begin, end = float(time[turns[0]]), float(time[turns[-1]])
    margin = max(0.5 * (period - (end - begin)), 0.0)
    ends = values[turns]
    return Oscillation(
        period=period,
        middle=float(np.median(ends[1:] + ends[:-1])) / 2.0,
        amplitude=float(np.median(np.abs(np.diff(ends)))) / 2.0,
        steady=(begin - margin, end + margin),
    )


def _white_noise(values: Array) -> float:
    """Return the standard deviation of white noise on a smooth motion, from third differences."""
    third = np.diff(values, 3)
    return float(1.4826 * np.median(np.abs(third - np.median(third))) / np.sqrt(20.0))


def _turning_points(values: Array, least: float) -> npt.NDArray[np.intp]:
    """Return where the motion turns round, coming back by more than `least`."""
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
    # A recording that begins on its way turns nowhere near its first sample.
    return np.array([turn for turn in turns if turn > 0], dtype=np.intp)


def _steady_run(spacing: Array) -> slice:
    """Return the longest run of turning points whose spacing is about the usual one."""
    steady = np.concatenate(([False], (spacing > 0.6) & (spacing < 1.6), [False]))
    edges = np.flatnonzero(~steady)
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]))


# The free swing.


class _Motion(NamedTuple):
    """Angle, rate and acceleration at the centres of short windows, shape (m,) each."""

    time: Array
    """Time stamps [s]."""
    elapsed: Array
    """Time since the first sample [s]."""
    angle: Array
    """Recorded angle, or the integral of the recorded rate [rad]."""
    rate: Array
    """Its rate, or the recorded rate [rad/s]."""
    acceleration: Array
    """The rate of that [rad/s^2]."""

    def where(self, chosen: npt.NDArray[np.bool_]) -> "_Motion":
        return _Motion(*(series[chosen] for series in self))


class _Law(NamedTuple):
    """The swing's equation with rough numbers."""

    w2: float
    offset: float
    c: float
    coulomb: float
    anchor: float
    """Angle at the first sample, which the integral of a rate lacks [rad]."""
    slow: float
    """Rate below which dry friction changes its sign smoothly [rad/s]."""
    is_rate: bool

    def theta(self, angle: Array, elapsed: Array) -> Array:
        """Return the angle from hanging [rad]."""
        return angle - self.offset * elapsed + self.anchor if self.is_rate else angle - self.offset

    def theta_dot(self, rate: Array) -> Array:
        """Return its rate [rad/s]."""
        return rate - self.offset if self.is_rate else rate

    def unexplained(self, motion: _Motion) -> Array:
        """Return the acceleration that gravity and friction do not explain [rad/s^2]."""
        theta_dot = self.theta_dot(motion.rate)
        friction = self.c * theta_dot + self.coulomb * np.tanh(theta_dot / self.slow)
        gravity = self.w2 * np.sin(self.theta(motion.angle, motion.elapsed))
        return motion.acceleration + gravity + friction


def find_free_swing(
    trajectory: Trajectory, rough: Oscillation, settings: IdentificationSettings
) -> FreeSwing:
    """Find the part that swings freely.

    Raises:
        RecordingError: It is shorter than a period, or goes over the top.
    """
    time, name = trajectory.time, trajectory.source
    # At least seven samples in a window, where sampling is slow.
    half = max(settings.local_periods * rough.period, 3.2 * float(np.median(np.diff(time))))
    angle = _angle(trajectory)
    motion = _local_motion(trajectory, angle, half)
    if len(motion.time) < 4:
        raise RecordingError(
            f"{name} has too many gaps in its time stamps: expected at least 5 samples in every "
            f"{2.0 * half:.3g} s; sample faster"
        )
    steady = (motion.time >= rough.steady[0]) & (motion.time <= rough.steady[1])
    if np.count_nonzero(steady) < 8:
        steady[:] = True
    law = _rough_law(motion.where(steady), rough, trajectory.theta is None)
    theta = law.theta(angle, time - time[0])
    first, last, release, warnings = 0, len(time) - 1, None, list[str]()
    if not trajectory.released:
        touched = _touched(motion, law, steady, rough.period, settings)
        begin, end = _longest_stretch(touched, law.theta_dot(motion.rate))
        if begin > 0:
            first = min(int(np.searchsorted(time, motion.time[begin - 1] + half)), last)
            release = float(time[first])
        if end < len(touched):
            last = int(np.searchsorted(time, motion.time[end] - half)) - 1
            warnings.append(
                f"something touched the pendulum at about {motion.time[end]:.2f} s: the recording "
                "is used up to there; choose the window with --start and --end"
            )
    if (over := _last_over_the_top(trajectory, law, theta, slice(first, last + 1))) is not None:
        raise _over_the_top(name, over)
    last = _last_before_rest(time, np.abs(theta), first, last, rough.period, settings.rest_share)
    if (lasts := float(time[last] - time[first]) if last > first else 0.0) < rough.period:
        raise RecordingError(
            f"{name} holds less than one period of a free swing: it is free for {lasts:.3g} s, and "
            f"a period is about {rough.period:.3g} s; record at least three periods after the hand "
            "lets go"
        )
    keep = slice(first, last + 1)
    # A cubic over the first window gives the first state.
    near = slice(first, first + max(int(np.searchsorted(time[keep], time[first] + 2 * half)), 6))
    powers = np.vander((time[near] - time[first]) / half, 4, increasing=True)
    value, slope = np.linalg.lstsq(powers, trajectory.values[near], rcond=None)[0][:2]
    value -= law.offset
    is_rate = law.is_rate
    return FreeSwing(
        keep=keep,
        release=release,
        w2=law.w2,
        c=law.c,
        theta=float(theta[first] if is_rate else value),
        theta_dot=float(value if is_rate else slope / half),
        offset=law.offset,
        warnings=warnings,
    )


def _angle(trajectory: Trajectory) -> Array:
    """Return the recorded angle, or the integral of the recorded rate [rad]."""
    if trajectory.theta is not None:
        return trajectory.theta
    from scipy.interpolate import CubicSpline

    elapsed = trajectory.time - trajectory.time[0]
    return np.asarray(CubicSpline(elapsed, trajectory.values).antiderivative()(elapsed))


def _local_motion(trajectory: Trajectory, angle: Array, half: float) -> _Motion:
    """Take angle, rate and acceleration over windows of half width `half` [s]."""
    time, values = trajectory.time, trajectory.values
    centres = np.arange(time[0] + half, time[-1] - half, half / 6.0)
    rows = np.full((len(centres), 3), np.nan)
    low = np.searchsorted(time, centres - half)
    high = np.searchsorted(time, centres + half, side="right")
    for i, (centre, a, b) in enumerate(zip(centres, low, high, strict=True)):
        rows[i] = _polynomial((time[a:b] - centre) / half, values[a:b])
    rows /= half ** np.arange(3)
    good = np.isfinite(rows[:, 0])
    centres, rows = centres[good], rows[good]
    elapsed = centres - time[0]
    if trajectory.theta is not None:
        return _Motion(centres, elapsed, rows[:, 0], rows[:, 1], rows[:, 2])
    return _Motion(centres, elapsed, np.interp(centres, time, angle), rows[:, 0], rows[:, 1])


def _polynomial(s: Array, values: Array) -> Array:
    """Return value, slope and curvature at s = 0; NaN where samples are few or have a gap."""
    if len(s) < 5 or float(np.max(np.diff(s, prepend=-1.0, append=1.0))) > 0.7:
        return np.full(3, np.nan)
    powers = np.vander(s, 5 if len(s) >= 7 else 4, increasing=True)
    coefficients = np.asarray(np.linalg.lstsq(powers, values, rcond=None)[0], dtype=np.float64)
    return coefficients[:3] * (1.0, 1.0, 2.0)


def _rough_law(motion: _Motion, rough: Oscillation, is_rate: bool) -> _Law:
    """Fit the equation to the accelerations; what does not follow it weighs little."""
    from scipy.optimize import least_squares

    w2 = _rough_w2(rough, is_rate)
    theta_dot = motion.rate - rough.middle if is_rate else motion.rate
    slow = 0.05 * float(np.quantile(np.abs(theta_dot), 0.9))
    size = float(np.quantile(np.abs(motion.acceleration), 0.9))
    # A recorded angle needs no anchor: its place is not fitted.
    n = 5 if is_rate else 4
    anchor = -float(np.median(motion.angle - rough.middle * motion.elapsed)) if is_rate else 0.0
    guess = np.array([w2, rough.middle, 0.01 * np.sqrt(w2), 1e-3 * size, anchor])
    low = np.array([0.25 * w2, -np.inf, 0.0, 0.0, -np.inf])
    high = np.array([4.0 * w2, np.inf, np.inf, np.inf, np.inf])
    scales = np.array([w2, rough.amplitude, np.sqrt(w2), size, 1.0])

    def law(x: Array) -> _Law:
        return _Law(*np.append(x, anchor)[:5].tolist(), slow=slow, is_rate=is_rate)

    solution = least_squares(
        lambda x: law(x).unexplained(motion) / size,
        guess[:n],
        bounds=(low[:n], high[:n]),
        x_scale=scales[:n],
        loss="cauchy",
        f_scale=0.03,
    )
    return law(solution.x)


def _rough_w2(rough: Oscillation, is_rate: bool) -> float:
    """Return w2 from period and amplitude A: T = 4 K(m) / sqrt(w2), with m = sin^2(A/2)."""
    from scipy.special import ellipk

    m = np.sin(0.5 * np.linspace(0.0, 0.97 * pi, 400)) ** 2
    K = np.asarray(ellipk(m))
    # A rate has the amplitude 2 sqrt(m w2).
    known = np.sqrt(m) * K if is_rate else np.sqrt(m)
    seen = rough.amplitude * rough.period / 8.0 if is_rate else np.sin(0.5 * rough.amplitude)
    return (4.0 * float(np.interp(seen, known, K)) / rough.period) ** 2


def _touched(
    motion: _Motion,
    law: _Law,
    steady: npt.NDArray[np.bool_],
    period: float,
    settings: IdentificationSettings,
) -> npt.NDArray[np.bool_]:
    """Tell in which windows something else than gravity and friction moves the pendulum."""
    unexplained = np.abs(law.unexplained(motion))
    # 0.6745 is the median of |N(0, 1)|.
    noise = float(np.median(unexplained[steady])) / 0.6745
    pull = law.w2 * np.abs(np.sin(law.theta(motion.angle, motion.elapsed)))
    low = np.searchsorted(motion.time, motion.time - 0.5 * period)
    high = np.searchsorted(motion.time, motion.time + 0.5 * period, side="right")
    peak = np.array([np.max(pull[a:b]) for a, b in zip(low, high, strict=True)])
    limit = np.maximum(settings.release_share * peak, settings.release_noise * noise)
    return unexplained > limit


def _longest_stretch(touched: npt.NDArray[np.bool_], rate: Array) -> tuple[int, int]:
    """Return the untouched stretch that moves the most: its first and past-the-last window."""
    edges = np.flatnonzero(touched)
    begins = np.concatenate(([0], edges + 1))
    ends = np.concatenate((edges, [len(touched)]))
    travel = np.concatenate(([0.0], np.cumsum(np.abs(rate))))
    longest = int(np.argmax(travel[ends] - travel[begins]))
    return int(begins[longest]), int(ends[longest])


def _last_over_the_top(
    trajectory: Trajectory, law: _Law, theta: Array, part: slice
) -> float | None:
    """Return when the pendulum last goes over the top [s], or none."""
    time, theta = trajectory.time[part], theta[part]
    if not law.is_rate:
        over = np.flatnonzero(np.abs(theta) >= pi)
        return float(time[over[-1]]) if over.size else None
    # The integral of a rate drifts, but not within a turn.
    falling = law.theta_dot(trajectory.values[part]) < 0.0
    turns = np.concatenate(([0], np.flatnonzero(np.diff(falling)), [len(time) - 1]))
    over = np.flatnonzero(np.abs(np.diff(theta[turns])) >= 2.0 * pi)
    return float(time[turns[over[-1] + 1]]) if over.size else None


def _last_before_rest(
    time: Array, size: Array, first: int, last: int, period: float, share: float
) -> int:
    """Return the last sample before the amplitude has fallen to `share` of its largest."""
    if last <= first:
        return last
    part = size[first : last + 1]
    moving = first + int(np.flatnonzero(part > share * float(np.max(part)))[-1])
    return min(last, int(np.searchsorted(time, time[moving] + 0.5 * period)))


def _over_the_top(name: str, until: float) -> RecordingError:
    # Rounded up, so that a window from there is free of it.
    after = ceil(100.0 * until + 1.0) / 100.0
    return RecordingError(
        f"{name}: the pendulum goes over the top, the last time before {after:.2f} s, expected a "
        f"swing to and fro below it; give --start {after:.2f} or release it from a smaller angle"
    )
