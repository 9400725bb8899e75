"""Least squares against the swing's own nonlinear equation, and how far to trust the result.

Everything is integrated with fixed steps, so that the prediction depends smoothly on the unknowns
and finite differences give its sensitivities; through an adaptive integrator they would not.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.identification.jackknife import blocks_of_time, jackknife
from equipoise.model.pendulum import PendulumParameters, swing
from equipoise.settings import Friction, IdentificationSettings

Array = npt.NDArray[np.float64]

W2, C, COULOMB, DRAG, THETA, THETA_DOT, OFFSET = range(7)
"""Places of the unknowns: four of the pendulum, its first state, zero offset (or gyro bias)."""

FRICTIONS: dict[Friction, list[int]] = {
    "viscous": [C],
    "coulomb": [C, COULOMB],
    "quadratic": [C, COULOMB, DRAG],
}
"""The unknowns of each friction model, from the paper's to the richest."""


class Recording(NamedTuple):
    """What is fitted."""

    time: Array
    """Time stamps [s], shape (n,)."""
    values: Array
    """Angle [rad], or rate [rad/s], as recorded; shape (n,)."""
    is_rate: bool
    """A gyro recorded the rate."""
    h: float
    """Length of the Runge-Kutta steps [s]."""
    w2_range: tuple[float, float]
    """Where w2 is looked for: upside down, with w2 < 0, every swing has a second solution."""

    def predict(self, unknowns: Array) -> Array:
        """Return what the sensor would have recorded, shape (n,)."""
        thetas, theta_dots = np.empty_like(self.time), np.empty_like(self.time)
        w2, c, coulomb, drag, theta, theta_dot, offset = map(float, unknowns)
        pendulum = PendulumParameters(w2, 0.0, c, coulomb, drag)
        swing(self.time, theta, theta_dot, self.h, pendulum, thetas, theta_dots)
        return (theta_dots if self.is_rate else thetas) + offset

    def residual(self, unknowns: Array) -> Array:
        """Return recorded minus predicted, shape (n,)."""
        return self.values - self.predict(unknowns)


class Fit(NamedTuple):
    """The unknowns that leave the least squares."""

    unknowns: Array
    """Values, shape (7,)."""
    fitted: list[int]
    """Places of the unknowns that were free."""
    bound: list[int]
    """Frictions that would have come out below zero, and were kept at zero."""


def fit_growing(
    recording: Recording, start: Array, period: float, settings: IdentificationSettings
) -> Fit:
    """Fit over a growing horizon: fitted at once, a long window has false minima.

    Args:
        recording: The free swing.
        start: First guess of the unknowns, shape (7,).
        period: Period of the swing [s].
        settings: Friction model and horizons.
    """
    time = recording.time
    length = float(np.ptp(time))
    fit = Fit(start, [], [])
    for share in (*settings.horizons, 1.0):
        horizon = max(share * length, min(settings.first_horizon_periods * period, length))
        n = int(np.searchsorted(time, time[0] + horizon, side="right"))
        part = recording._replace(time=time[:n], values=recording.values[:n])
        fit = fit_bounded(part, settings.friction, fit.unknowns)
    return fit


def fit_bounded(recording: Recording, friction: Friction, start: Array) -> Fit:
    """Fit with all frictions of a model at zero or above.

    Args:
        recording: The free swing.
        friction: The friction model.
        start: First guess of the unknowns, shape (7,).
    """
    frictions, bound = list(FRICTIONS[friction]), list[int]()
    unknowns = start
    while True:
        fitted = [W2, *frictions, THETA, THETA_DOT, OFFSET]
        unknowns = _least_squares(recording, unknowns, fitted)
        scales = _scales(unknowns)
        worst = min(frictions, key=lambda i: unknowns[i] / scales[i], default=W2)
        if unknowns[worst] > 0.0:
            return Fit(unknowns, fitted, bound)
        # What the others become, to first order, when the worst friction goes to zero: started
        # elsewhere, the next fit would creep along a narrow valley.
        others = [i for i in fitted if i != worst]
        J = sensitivities(recording, unknowns, [*others, worst])
        change = np.linalg.lstsq(
            J[:, :-1] * scales[others], J[:, -1] * unknowns[worst], rcond=None
        )[0]
        unknowns[others] += change * scales[others]
        frictions.remove(worst)
        bound.append(worst)
        unknowns[bound] = 0.0
        if not np.all(np.isfinite(recording.predict(unknowns))):
            unknowns = start.copy()
            unknowns[bound] = 0.0


def _least_squares(recording: Recording, start: Array, fitted: list[int]) -> Array:
    from scipy.optimize import least_squares

    unknowns, scales = start.copy(), _scales(start)[fitted]
    low, high = np.full(scales.shape, -np.inf), np.full(scales.shape, np.inf)
    low[0], high[0] = recording.w2_range
    guess = start[fitted].copy()
    guess[0] = np.clip(guess[0], 1.001 * low[0], 0.999 * high[0])

    def at(x: Array) -> Array:
        unknowns[fitted] = x * scales
        return unknowns

    solution = least_squares(
        lambda x: -recording.residual(at(x)),
        guess / scales,
        # The stub of SciPy knows a name here, but no function.
        jac=lambda x: sensitivities(recording, at(x), fitted) * scales,  # pyright: ignore[reportArgumentType]
        bounds=(low / scales, high / scales),
        x_scale="jac",
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-12,
    )
    return at(solution.x).copy()


def _scales(unknowns: Array) -> Array:
    """Return the natural size of each unknown, shape (7,)."""
    w2 = abs(unknowns[W2])
    root = np.sqrt(w2)
    return np.array([w2, root, w2, 1.0, 1.0, root, 1.0])


def sensitivities(recording: Recording, unknowns: Array, places: list[int]) -> Array:
    """Return the derivatives of the prediction by the unknowns at `places`, shape (n, p)."""
    sizes = 1e-6 * _scales(unknowns)
    columns: list[Array] = []
    for i in places:
        up, down = unknowns.copy(), unknowns.copy()
        up[i] += sizes[i]
        down[i] -= sizes[i]
        columns.append((recording.predict(up) - recording.predict(down)) / (2.0 * sizes[i]))
    return np.stack(columns, axis=1)


def covariance(recording: Recording, fit: Fit, blocks: int) -> Array:
    """Return the covariance of the unknowns from a jackknife over blocks of time.

    How far the estimate moves when one block is left out says how far it can be trusted, also
    where the residuals within a block hang together. A friction that was kept at zero gets the
    spread that it would have had; the others do not pay for it.

    Args:
        recording: The free swing.
        fit: Its fit.
        blocks: Number of blocks, of equal length in time.

    Returns:
        Shape (7, 7); zero where an unknown does not belong to the model.
    """
    spread = np.zeros((7, 7))
    spread[np.ix_(fit.fitted, fit.fitted)] = _jackknife(recording, fit, fit.fitted, blocks)
    for place in fit.bound:
        spread[place, place] = _jackknife(recording, fit, [*fit.fitted, place], blocks)[-1, -1]
    return spread


def _jackknife(recording: Recording, fit: Fit, places: list[int], blocks: int) -> Array:
    """Return the covariance at `places`."""
    scales = _scales(fit.unknowns)[places]
    J = sensitivities(recording, fit.unknowns, places) * scales
    residual = recording.residual(fit.unknowns)
    block = blocks_of_time(recording.time, blocks)
    return jackknife(J, residual, block) * np.outer(scales, scales)


def rms(residual: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(residual**2)))
