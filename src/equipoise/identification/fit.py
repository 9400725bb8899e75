"""Least-squares fit of the nonlinear swing equation, with the covariance of its result.

Fixed integration steps make the prediction a smooth function of the unknowns, so that finite
differences give its sensitivities; an adaptive integrator would not.
"""

from collections.abc import Callable
from math import sqrt
from typing import Final, NamedTuple

import numpy as np

from equipoise.arrays import Array
from equipoise.identification.least_squares import fit_unknowns, jackknife, sensitivities
from equipoise.model.pendulum import STEPS_PER_PERIOD, PendulumParameters, swing
from equipoise.settings import Friction

W2, C, COULOMB, DRAG, THETA, THETA_DOT, OFFSET, SCALE = range(8)
"""Indices of the unknowns: four of the pendulum, its initial state, zero offset (or gyro bias), and
the true motion as a fraction of the recorded one, which is 1 except in a diagnosis."""

FRICTIONS: Final[dict[Friction, list[int]]] = {
    "viscous": [C],
    "coulomb": [C, COULOMB],
    "quadratic": [C, COULOMB, DRAG],
}
"""Unknowns of each friction model, from the paper's to the richest."""
COARSE, FINE = 1e-6, 1e-12
"""Relative changes of the sum of squares at which a fit of a part and a final fit stop."""


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
        """Return recorded minus predicted values, shape (n,); 1e9 where a prediction diverged."""
        missed = np.nan_to_num(self.values - self.predict(unknowns), nan=1e9)
        return np.clip(missed, -1e9, 1e9)

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


def fit_swing(
    recording: SwingRecording, start: Array, friction: Friction, show: Callable[[str], None]
) -> Array:
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
    for model in FRICTIONS:
        show(f"fitting {model} friction to {periods:.0f} periods")
        best = fit_bounded(recording, model, best)
        if model == friction:
            break
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
