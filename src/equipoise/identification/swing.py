r"""Identification of a pendulum from a recorded free swing.

.. math:: \ddot\theta = -w_2 \sin\theta - c\,\dot\theta - f\,\mathrm{sign}\,\dot\theta
          - d\,\dot\theta|\dot\theta|

The recorded value is theta plus the zero offset of an encoder, or theta_dot of a gyro plus a bias.

1. Detect the free swing from its turning points. A free pendulum turns at regular times, and its
   swings shrink. The fit takes the longest such stretch, from turning point to turning point: a
   hand that holds, lifts or stops the pendulum turns it at other times, and one that pushes it
   makes the swings grow. At a turning point the initial state is known: an angle turns at rest,
   and a rate in the lowest position.
2. Fit the nonlinear equation by least squares over a growing horizon. Fixed integration steps make
   the prediction a smooth function of the unknowns, so that finite differences give its
   sensitivities; an adaptive integrator would not.
3. Compute intervals with a jackknife over periods. Residuals of real swings are autocorrelated;
   errors that assume independence are up to 39 times too small.
4. If the model does not explain the recording, find one that does: with richer friction, or of a
   swing of another size, whose period varies less or more with the amplitude than that of the
   recorded angles. A wrong unit is such a case, and a spring, whose period does not vary.
"""

from collections.abc import Callable
from math import degrees, pi, radians, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.arguments import checked
from equipoise.arrays import Array
from equipoise.errors import RecordingError
from equipoise.files import Estimate, StrPath
from equipoise.identification.least_squares import (
    fit_unknowns,
    half_width,
    jackknife,
    sensitivities,
)
from equipoise.identification.recording import Trajectory, read_swing
from equipoise.model.pendulum import STEPS_PER_PERIOD, Pendulum, PendulumParameters, SwingFit, swing
from equipoise.settings import Friction, IdentificationSettings

Progress = Callable[[str], None]
"""Callback; receives the progress in a few words."""
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

    def residual(self, unknowns: Array) -> Array:
        """Return recorded minus predicted values, shape (n,); 1e30 where a prediction diverged."""
        w2, c, coulomb, drag, theta, theta_dot, offset, scale = map(float, unknowns)
        pendulum = PendulumParameters(w2, 0.0, c, coulomb, drag)
        h = self.period / STEPS_PER_PERIOD
        thetas, theta_dots = swing(self.time, scale * theta, scale * theta_dot, h, pendulum)
        predicted = (theta_dots if self.is_rate else thetas) / scale + offset
        return np.clip(np.nan_to_num(self.values - predicted, nan=1e30), -1e30, 1e30)

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


MODELS: Final[tuple[Friction, ...]] = ("viscous", "coulomb", "quadratic")
"""Friction models, from the paper's to the richest; each adds the friction of its name."""
FRICTIONS: Final = {model: [C, COULOMB, DRAG][: n + 1] for n, model in enumerate(MODELS)}
"""Unknowns of each friction model."""
COARSE, FINE = 1e-6, 1e-12
"""Relative changes of the sum of squares at which a fit of a part and a final fit stop."""
WARNING_MISFIT: Final = 0.005
"""Fraction of the amplitude left unexplained above which a warning is given: a well-modelled pivot
leaves 0.1 to 0.4 %."""
MAX_MISFIT: Final = 0.25
"""Largest accepted misfit (residual without noise), as a fraction of the recording's standard
deviation; more is not a free swing. A long swing with the wrong friction model leaves 5 %."""
SMALL_SWING: Final = radians(10.0)
"""Amplitude below which the period grows with the amplitude by less than 0.2 % [rad]."""


@checked
def identify(
    trajectory: Trajectory | StrPath,
    settings: IdentificationSettings | None = None,
    mass: Estimate | None = None,
    length: Estimate | None = None,
    show: Progress = lambda _: None,
) -> Pendulum:
    """Identify a pendulum from a recorded free swing.

    Args:
        trajectory: The recording, of a pivot at rest, or its file, as `read_swing` takes it; it may
            start with a hand on the pendulum.
        settings: Settings of the fit.
        mass: Mass m of all rotating parts [kg], measured separately.
        length: Distance l from the axis to their centre of mass [m], measured separately. With
            both, the moment of inertia I and the friction b are computed in SI units.
        show: Called with the progress in a few words.

    Returns:
        The pendulum, with 95 % intervals, and warnings about a poor fit.

    Raises:
        RecordingError: The recording holds no free swing of at least one period.
    """
    trajectory = trajectory if isinstance(trajectory, Trajectory) else read_swing(trajectory)
    settings = settings or IdentificationSettings()
    friction, (recording, start) = settings.friction, find_free_swing(trajectory)
    unknowns = fit_swing(recording, start, friction, show)
    begin, end = float(recording.time[0]), float(recording.time[-1])
    misfit = recording.misfit(unknowns, trajectory.resolution)
    fit = SwingFit(
        source=trajectory.source,
        sha256=trajectory.sha256,
        quantity="rate" if recording.is_rate else "angle",
        window=(begin, end),
        release=None if trajectory.released else begin,
        samples=len(recording.time),
        periods=(end - begin) / recording.period,
        rms=recording.rms(unknowns),
        noise=recording.noise(unknowns, trajectory.resolution),
        offset=float(unknowns[OFFSET]),
        theta=float(unknowns[THETA]),
        theta_dot=float(unknowns[THETA_DOT]),
        settings=settings,
    )
    richer, advice = None, ""
    if fit.unexplained > WARNING_MISFIT:
        richer, advice = _advice(recording, unknowns, friction, start, show)
    if (left := misfit / float(np.std(recording.values))) > MAX_MISFIT:
        raise RecordingError(
            f"{trajectory.source} is not one free swing with {friction} friction: the "
            f"pendulum's equation leaves {left:.0%} of the motion from {begin:.2f} s to "
            f"{end:.2f} s unexplained, expected less than {MAX_MISFIT:.0%}; "
            f"{advice or 'choose a free swing with --start and --end'}"
        )
    warnings: list[str] = []
    if fit.unexplained > WARNING_MISFIT:
        warnings.append(
            f"{friction} friction leaves {fit.unexplained:.1%} of the amplitude unexplained, "
            "and its numbers hold only near the amplitudes of this window; "
            + (advice or "look for play, vibration or a moving pivot, or choose another window")
        )
    warnings += [
        f"{MODELS[place - C]} friction is kept at zero: the recording shows none beside the others"
        for place in at_bound(unknowns, friction)
    ]
    if fit.periods < 3.0:
        warnings.append(
            f"the swing lasts {fit.periods:.1f} periods only, and the intervals are rough; "
            "record ten, with less friction if it stops sooner"
        )
    # On one rig w2 was 1.4 % higher at 3.6 deg than at 56 deg, and differed by 0.2 % from there to
    # 149 deg.
    if (largest := _amplitude(recording, unknowns)) < SMALL_SWING:
        warnings.append(
            f"the swing stays within {degrees(largest):.2g} deg, where play and dry friction count "
            "most: the intervals do not cover that w2 may be 1 or 2 % lower in larger swings; "
            "release the pendulum from 40 to 60 deg"
        )
    # A block is a period, or shorter in a window of few periods: the scatter of fewer blocks is
    # meaningless.
    blocks = max(round(fit.periods), 8)
    spread = covariance(recording, unknowns, friction, blocks)

    def estimate(place: int, factor: float = 1.0) -> Estimate:
        fitted = place in (W2, *FRICTIONS[friction])
        width = factor * half_width(spread[place, place], blocks)
        source = "identified" if fitted else "assumed"
        return Estimate.around(factor * float(unknowns[place]), width, source).not_negative()

    pendulum = Pendulum(
        w2=estimate(W2),
        k=estimate(W2, 1.0 / settings.g),
        c=estimate(C),
        coulomb=estimate(COULOMB),
        drag=estimate(DRAG),
        covariance=tuple(map(tuple, spread[: DRAG + 1, : DRAG + 1].tolist())),
        friction_model=friction,
        g=settings.g,
        fit=fit.model_copy(update={"warnings": tuple(warnings), "richer_friction": richer}),
    )
    return _weighed(pendulum, mass, length, blocks) if mass and length else pendulum


def _advice(
    recording: SwingRecording, unknowns: Array, friction: Friction, start: Array, show: Progress
) -> tuple[Friction | None, str]:
    """Return the simplest friction that leaves less than half of the misfit, or None, and advice.

    Without such a friction, the advice names a spring or a wrong unit, or is empty.
    """
    enough, better = 0.5 * recording.misfit(unknowns), unknowns
    for model in MODELS[MODELS.index(friction) + 1 :]:
        show(f"trying {model} friction")
        better = fit_bounded(recording, model, better)
        if recording.misfit(better) < enough:
            return model, f"try --friction {model}"
    # A small swing is the start: its equation is linear.
    scaled, start = recording._replace(any_scale=True), start.copy()
    start[THETA_DOT if recording.is_rate else THETA] = recording.values[0] - start[OFFSET]
    start[W2] = (2.0 * pi / recording.period) ** 2
    start[SCALE] = SMALL_SWING / _amplitude(recording, start)
    better = fit_swing(scaled, start, MODELS[-1], show)
    if not recording.misfit(better) < enough:
        return None, ""
    if _amplitude(recording, better) < SMALL_SWING:
        return None, (
            "its period does not depend on the amplitude: a spring or a cable moves it, or the "
            "values are too large for their unit; let the pendulum swing freely"
        )
    scale = float(better[SCALE])
    factor = f"{1.0 / scale:.3g} times smaller" if scale < 1.0 else f"{scale:.3g} times larger"
    return None, (
        f"its period is that of a swing {factor} than recorded: check the unit (1 rad is 57.3 deg) "
        "and --counts-per-rev"
    )


def _amplitude(recording: SwingRecording, unknowns: Array) -> float:
    """Return the amplitude at the first turning point [rad]; that of a small swing for a rate."""
    radius = recording.period / (2.0 * pi) if recording.is_rate else 1.0
    place = THETA_DOT if recording.is_rate else THETA
    return abs(float(unknowns[place] * unknowns[SCALE])) * radius


def _weighed(pendulum: Pendulum, mass: Estimate, length: Estimate, blocks: int) -> Pendulum:
    """Return a pendulum with I = m g l / w2 and b = c I, with errors to first order."""
    w2, c = pendulum.w2.value, pendulum.c.value
    I = mass.value * pendulum.g * length.value / w2
    of_ml = np.hypot(mass.half_width / mass.value, length.half_width / length.value)
    of_I = np.hypot(of_ml, pendulum.w2.half_width / w2)
    gradient, spread = np.array([-c / w2, 1.0]), np.array(pendulum.covariance)[:2, :2]
    of_b = np.hypot(c * of_ml, half_width(float(gradient @ spread @ gradient), blocks))
    inertia = Estimate.around(I, I * float(of_I), "identified").not_negative()
    friction = Estimate.around(c * I, I * float(of_b), "identified").not_negative()
    known = {"mass": mass, "length": length, "inertia": inertia, "friction": friction}
    return pendulum.model_copy(update=known)


def fit_swing(recording: SwingRecording, start: Array, friction: Friction, show: Progress) -> Array:
    """Fit the recording over a growing horizon; return the unknowns, shape (8,).

    A long window that is fitted at once has local minima that are off by a period. A richer
    friction model starts from the solution of the simpler one, and is never worse.

    Args:
        recording: The free swing.
        start: Initial guess of the unknowns, shape (8,).
        friction: The friction model.
        show: Called with the progress in a few words.
    """
    elapsed = recording.time - recording.time[0]
    periods = elapsed[-1] / recording.period
    # A shorter horizon does not determine period and friction.
    best, horizon = start, 1.5 * recording.period
    while horizon < elapsed[-1]:
        show(f"fitting {horizon / recording.period:.0f} of {periods:.0f} periods")
        end = int(np.searchsorted(elapsed, horizon, side="right"))
        part = recording._replace(time=recording.time[:end], values=recording.values[:end])
        best = fit_bounded(part, "viscous", best, COARSE)
        horizon *= 2.0
    for model in MODELS[: MODELS.index(friction) + 1]:
        show(f"fitting {model} friction to {periods:.0f} periods")
        best = fit_bounded(recording, model, best)
    return best


def fit_bounded(
    recording: SwingRecording, friction: Friction, start: Array, tolerance: float = FINE
) -> Array:
    """Fit a friction model; fix a friction that comes out negative at zero, the worst one first.

    Args:
        recording: The free swing.
        friction: The friction model.
        start: Initial guess of the unknowns, shape (8,).
        tolerance: Relative change of the sum of squares at which the fit stops.

    Returns:
        The unknowns, shape (8,); those of `start` where no others fit better.
    """
    low, high = np.full(8, -np.inf), np.full(8, np.inf)
    # A second, upside-down solution has w2 < 0.
    low[W2], high[W2] = 0.25 * start[W2], 4.0 * start[W2]
    low[SCALE], high[SCALE] = 1e-3, 1e3
    unknowns, kept = start.copy(), list(FRICTIONS[friction])
    while True:
        unknowns = fit_unknowns(
            recording.residual,
            unknowns,
            [W2, *kept, THETA, THETA_DOT, OFFSET, *([SCALE] if recording.any_scale else [])],
            _scales(unknowns),
            (low, high),
            jac="3-point",
            xtol=100.0 * tolerance,
            ftol=tolerance,
            gtol=tolerance,
            max_nfev=50,  # those of recorded swings take up to 21
        )
        if all(unknowns[place] > 0.0 for place in kept):
            return min(start, unknowns, key=recording.rms)
        worst = min(kept, key=lambda place: unknowns[place] / _scales(unknowns)[place])
        kept.remove(worst)
        unknowns[worst] = 0.0


def _scales(unknowns: Array) -> Array:
    """Return the scale of each unknown, shape (8,)."""
    w2 = abs(unknowns[W2])
    root = np.sqrt(w2)
    return np.array([w2, root, w2, 1.0, 1.0, root, 1.0, 1.0])


def covariance(
    recording: SwingRecording, unknowns: Array, friction: Friction, blocks: int
) -> Array:
    """Estimate the covariance of the unknowns with a jackknife over blocks of time.

    The jackknife stays valid for autocorrelated residuals. A friction that was fixed at zero gets
    the variance of a free one and does not widen the other intervals.

    Args:
        recording: The free swing.
        unknowns: Its fit, shape (8,).
        friction: The friction model.
        blocks: Number of blocks of equal duration.

    Returns:
        Shape (8, 8); zero for unknowns outside the model.
    """
    residual, scales = recording.residual(unknowns), _scales(unknowns)

    def of(places: list[int]) -> Array:
        J = sensitivities(recording.residual, unknowns, places, scales)
        spread = jackknife(J, residual, recording.time, blocks)
        return spread * np.outer(scales[places], scales[places])

    spread, bound = np.zeros((8, 8)), at_bound(unknowns, friction)
    free = [place for place in FRICTIONS[friction] if place not in bound]
    fitted = [W2, *free, THETA, THETA_DOT, OFFSET]
    spread[np.ix_(fitted, fitted)] = of(fitted)
    for place in bound:
        spread[place, place] = of([*fitted, place])[-1, -1]
    return spread


def at_bound(unknowns: Array, friction: Friction) -> list[int]:
    """Return the frictions of a model that were fixed at zero, their lower bound."""
    return [place for place in FRICTIONS[friction] if unknowns[place] == 0.0]
