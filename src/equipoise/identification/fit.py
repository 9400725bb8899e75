"""Least-squares fit of the nonlinear swing equation, with the covariance of its result.

Fixed integration steps make the prediction a smooth function of the unknowns, so that finite
differences give its sensitivities; an adaptive integrator would not.
"""

from collections.abc import Sequence
from math import ceil, inf, log, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.identification.least_squares import blocks_of_time, jackknife
from equipoise.model.pendulum import STEPS_PER_PERIOD, PendulumParameters, swing
from equipoise.settings import Friction

Array = npt.NDArray[np.float64]

W2, C, COULOMB, DRAG, THETA, THETA_DOT, OFFSET = range(7)
"""Indices of the unknowns: four of the pendulum, its initial state, zero offset (or gyro bias)."""

FRICTIONS: dict[Friction, list[int]] = {
    "viscous": [C],
    "coulomb": [C, COULOMB],
    "quadratic": [C, COULOMB, DRAG],
}
"""Unknowns of each friction model, from the paper's to the richest."""

MAX_MISFIT = 0.05
"""Largest misfit of a fit in the global minimum, as a share of the motion's standard deviation. The
wrong friction model over 60 periods leaves that much."""
MAX_UNEXPLAINED: Final = 0.25
"""Largest accepted misfit (residual without noise), as a share of the recording's standard
deviation; more is not a free swing. A long swing with the wrong friction model leaves 5 %."""
HORIZONS: Final = (0.08, 0.25)
"""Shares of the window that are fitted in sequence before the whole: a long window that is
fitted at once has local minima that are off by a period."""
FIRST_HORIZON: Final = 1.5
"""Minimum length of the first horizon in periods; a shorter one does not determine period and
friction."""
COARSE, FINE = 1e-6, 1e-12
"""Relative changes of the sum of squares at which a comparison and a final fit stop."""


class SwingRecording(NamedTuple):
    """Samples to fit, each the mean over a short time."""

    begin: float
    """Time of the initial state [s]."""
    time: Array
    """Mean times of the samples [s], shape (n,)."""
    values: Array
    """Mean angle [rad], or rate [rad/s], as recorded; shape (n,)."""
    spread: Array
    """Standard deviation of the times within a mean [s], shape (n,); zero for single samples."""
    is_rate: bool
    """Whether a gyro recorded the rate."""
    period: float
    """Period of the swing [s]."""
    w2_range: tuple[float, float]
    """Bounds of w2 [1/s^2]; they exclude the second, upside-down solution with w2 < 0."""

    def part(self, kept: slice) -> "SwingRecording":
        """Return some of the samples."""
        time, values, spread = self.time[kept], self.values[kept], self.spread[kept]
        return self._replace(time=time, values=values, spread=spread)

    def predict(self, unknowns: Array) -> Array:
        """Simulate the recorded values, shape (n,).

        The mean of a smooth motion over a short time equals the mean of its two values one standard
        deviation before and after the mean time, up to the fourth order.
        """
        averaged = bool(np.any(self.spread))
        points = [self.time - self.spread, self.time + self.spread] if averaged else [self.time]
        time = np.concatenate(([self.begin], np.stack(points, axis=1).ravel()))
        thetas, theta_dots = np.empty_like(time), np.empty_like(time)
        w2, c, coulomb, drag, theta, theta_dot, offset = map(float, unknowns)
        pendulum = PendulumParameters(w2, 0.0, c, coulomb, drag)
        h = self.period / STEPS_PER_PERIOD
        swing(time, theta, theta_dot, h, pendulum, thetas, theta_dots)
        motion = (theta_dots if self.is_rate else thetas)[1:]
        return motion.reshape(-1, len(points)).mean(axis=1) + offset

    def residual(self, unknowns: Array) -> Array:
        """Return recorded minus predicted values, shape (n,)."""
        return self.values - self.predict(unknowns)

    def rms(self, unknowns: Array) -> float:
        """Return the root mean square residual."""
        return rms(self.residual(unknowns))

    def misfit_share(self, unknowns: Array) -> float:
        """Return the misfit as a share of the motion's standard deviation."""
        residual = self.residual(unknowns)
        return misfit(rms(residual), noise_of(residual)) / float(np.std(self.values))


class FittedUnknowns(NamedTuple):
    """Result of a least-squares fit."""

    unknowns: Array
    """Values, shape (7,)."""
    fitted: list[int]
    """Indices of the free unknowns."""
    bound: list[int]
    """Indices of frictions that were fixed at zero, their lower bound."""


def fit_growing(
    recording: SwingRecording, starts: Sequence[Array], friction: Friction
) -> FittedUnknowns:
    """Fit the recording over a growing horizon.

    A long window has local minima if it is fitted at once. After a poor fit, other initial states
    and horizons that grow more slowly are tried, until two attempts end in the same minimum. A fit
    that would be rejected does not end the search before all attempts are made.

    Args:
        recording: The free swing.
        starts: Initial guesses of the unknowns, the likeliest first; shape (7,) each.
        friction: The friction model.
    """
    length = float(recording.time[-1] - recording.begin)
    first = min(FIRST_HORIZON * recording.period, length)
    growing = [max(share * length, first) for share in HORIZONS]
    slowly = [first * 1.5**i for i in range(ceil(log(length / first, 1.5)))]
    others = starts[1:]
    attempts = [(growing, starts[0]), *((slowly, start) for start in others[:1])]
    attempts += [*((growing, start) for start in others), (slowly, starts[0])]
    found = list[tuple[float, Array]]()
    for horizons, unknowns in attempts:
        for horizon in (*horizons, length):
            end = np.searchsorted(recording.time, recording.begin + horizon, side="right")
            part = recording.part(slice(int(end)))
            unknowns = fit_bounded(part, friction, unknowns, COARSE).unknowns
        share = recording.misfit_share(unknowns)
        again = any(abs(share - other) < 0.01 * other for other, _ in found)
        found.append((share, unknowns))
        if share < MAX_MISFIT or (again and share < MAX_UNEXPLAINED):
            break
    best = min(found, key=lambda one: one[0])[1]
    return fit_bounded(recording, friction, best, FINE)


def fit_richer(
    recording: SwingRecording, friction: Friction, simple: FittedUnknowns
) -> FittedUnknowns:
    """Fit a friction model roughly from the optimum of a simpler one; return the better of both.

    Args:
        recording: The free swing.
        friction: The richer friction model.
        simple: Best fit of a simpler model.
    """
    known = simple.unknowns
    # The other frictions start at half the power of the viscous one in the first period.
    rate = max(float(np.ptp(recording.predict(known))) / 2.0, 1e-9)
    rate *= 1.0 if recording.is_rate else sqrt(known[W2])
    starts = [known]
    for place, share in ((COULOMB, 0.8 * rate), (DRAG, 1.2 / rate)):
        if place in FRICTIONS[friction]:
            start = known.copy()
            start[C] /= 2.0
            start[place] = share * start[C]
            starts.append(start)
    fits = [simple, *(fit_bounded(recording, friction, start, COARSE) for start in starts)]
    return min(fits, key=lambda fit: recording.rms(fit.unknowns))


def fit_bounded(
    recording: SwingRecording, friction: Friction, start: Array, tolerance: float
) -> FittedUnknowns:
    """Fit a friction model; fix a friction that comes out negative at zero, the worst one first.

    Args:
        recording: The free swing.
        friction: The friction model.
        start: Initial guess of the unknowns, shape (7,).
        tolerance: Relative change of the sum of squares at which the fit stops.
    """
    unknowns, kept, bound = start.copy(), list(FRICTIONS[friction]), list[int]()
    while True:
        unknowns[bound] = 0.0
        fitted = [W2, *kept, THETA, THETA_DOT, OFFSET]
        unknowns = _least_squares(recording, unknowns, fitted, tolerance)
        sizes = unknowns / _scales(unknowns)
        if all(unknowns[place] > 0.0 for place in kept):
            return FittedUnknowns(unknowns, fitted, bound)
        worst = min(kept, key=lambda place: sizes[place])
        kept.remove(worst)
        bound.append(worst)


def _least_squares(
    recording: SwingRecording, start: Array, fitted: list[int], tolerance: float
) -> Array:
    from scipy.optimize import least_squares

    unknowns, scales = start.copy(), _scales(start)[fitted]
    low, high = np.full(scales.shape, -np.inf), np.full(scales.shape, np.inf)
    low[0], high[0] = recording.w2_range
    guess = start[fitted].copy()
    guess[0] = np.clip(guess[0], 1.001 * low[0], 0.999 * high[0])

    def at(x: Array) -> Array:
        unknowns[fitted] = x * scales
        return unknowns

    def jacobian(x: Array) -> Array:
        # Where a motion begins to diverge, it has no derivative, and no influence on the step.
        J = sensitivities(recording, at(x), fitted) * scales
        return np.where(np.isfinite(J), J, 0.0)

    if not np.all(np.isfinite(recording.predict(at(guess / scales)))):
        # The friction is too stiff for the integration steps.
        return start.copy()
    solution = least_squares(
        lambda x: -recording.residual(at(x)),
        guess / scales,
        # SciPy's stub accepts a name here, but no function.
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        bounds=(low / scales, high / scales),
        x_scale="jac",
        xtol=100.0 * tolerance,
        ftol=tolerance,
        gtol=tolerance,
    )
    return at(solution.x).copy()


def _scales(unknowns: Array) -> Array:
    """Return the scale of each unknown, shape (7,)."""
    w2 = abs(unknowns[W2])
    root = np.sqrt(w2)
    return np.array([w2, root, w2, 1.0, 1.0, root, 1.0])


def sensitivities(recording: SwingRecording, unknowns: Array, places: list[int]) -> Array:
    """Return the derivatives of the prediction by the unknowns `places`, shape (n, p)."""
    sizes = 1e-6 * _scales(unknowns)
    columns: list[Array] = []
    for i in places:
        up, down = unknowns.copy(), unknowns.copy()
        up[i] += sizes[i]
        down[i] -= sizes[i]
        columns.append((recording.predict(up) - recording.predict(down)) / (2.0 * sizes[i]))
    return np.stack(columns, axis=1)


def covariance(recording: SwingRecording, fit: FittedUnknowns, blocks: int) -> Array:
    """Estimate the covariance of the unknowns with a jackknife over blocks of time.

    The jackknife stays valid for autocorrelated residuals. A friction that was fixed at zero gets
    the variance of a free one and does not widen the other intervals.

    Args:
        recording: The free swing.
        fit: Its fit.
        blocks: Number of blocks of equal duration.

    Returns:
        Shape (7, 7); zero for unknowns outside the model.
    """
    residual, block = recording.residual(fit.unknowns), blocks_of_time(recording.time, blocks)
    scales = _scales(fit.unknowns)

    def of(places: list[int]) -> Array:
        J = sensitivities(recording, fit.unknowns, places) * scales[places]
        return jackknife(J, residual, block) * np.outer(scales[places], scales[places])

    spread = np.zeros((7, 7))
    spread[np.ix_(fit.fitted, fit.fitted)] = of(fit.fitted)
    for place in fit.bound:
        spread[place, place] = of([*fit.fitted, place])[-1, -1]
    return spread


def rms(residual: Array) -> float:
    """Return the root mean square; infinity for a prediction that diverged."""
    return sqrt(float(np.mean(residual**2))) if np.all(np.isfinite(residual)) else inf


def noise_of(residual: Array, resolution: float = 0.0) -> float:
    """Estimate the white noise in a residual, at least the quantization noise of the sensor."""
    if not np.all(np.isfinite(residual)):
        return 0.0
    return max(float(np.std(np.diff(residual))) / sqrt(2.0), resolution / sqrt(12.0))


def misfit(residual: float, noise: float) -> float:
    """Return the part of a residual's root mean square that noise does not explain."""
    return sqrt(max(residual**2 - noise**2, 0.0))
