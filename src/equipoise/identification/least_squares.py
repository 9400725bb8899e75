"""Least-squares fits, and their covariance by a block jackknife for autocorrelated residuals."""

from collections.abc import Callable
from math import inf, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array

Misfit = Callable[[Array], Array]
"""Function of the unknowns: predicted minus measured, shape (n,)."""


def fit_unknowns(
    misfit: Misfit,
    start: Array,
    fitted: list[int],
    scales: Array,
    bounds: tuple[float | Array, float | Array] = (-inf, inf),
    **options: Any,
) -> Array:
    """Return the unknowns with the least sum of squared misfits, shape (k,).

    Args:
        misfit: Returns predicted minus measured for all unknowns, shape (n,).
        start: Initial guess of all unknowns, shape (k,).
        fitted: Indices of the free unknowns.
        scales: Scale of each unknown, shape (k,).
        bounds: Lower and upper bounds of all unknowns.
        options: Tolerances and the like, for `scipy.optimize.least_squares`.
    """
    from scipy.optimize import least_squares

    low, high = (np.broadcast_to(end, start.shape)[fitted] / scales[fitted] for end in bounds)
    solution = least_squares(
        _scaled(misfit, start, fitted, scales),
        np.clip(start[fitted] / scales[fitted], low + 1e-3, high - 1e-3),
        bounds=(low, high),
        x_scale="jac",
        **options,
    )
    unknowns = start.copy()
    unknowns[fitted] = solution.x * scales[fitted]
    return unknowns


def sensitivities(misfit: Misfit, unknowns: Array, fitted: list[int], scales: Array) -> Array:
    """Return central differences of the misfit by the fitted unknowns over their scales.

    Args:
        misfit: Returns predicted minus measured for all unknowns, shape (n,).
        unknowns: All unknowns, shape (k,).
        fitted: Indices of the free ones.
        scales: Scale of each unknown, shape (k,).

    Returns:
        Shape (n, number of fitted).
    """
    of_fitted, at = _scaled(misfit, unknowns, fitted, scales), unknowns[fitted] / scales[fitted]
    steps = 1e-6 * np.eye(len(fitted))
    columns = [(of_fitted(at + step) - of_fitted(at - step)) / 2e-6 for step in steps]
    return np.stack(columns, axis=1)


def _scaled(misfit: Misfit, start: Array, fitted: list[int], scales: Array) -> Misfit:
    """Return the misfit as a function of the fitted unknowns over their scales."""

    def of_fitted(x: Array) -> Array:
        unknowns = start.copy()
        unknowns[fitted] = x * scales[fitted]
        return misfit(unknowns)

    return of_fitted


def blocks_of_time(time: Array, blocks: int) -> npt.NDArray[np.intp]:
    """Return the index of the block of equal duration that holds each sample, shape (n,)."""
    elapsed = time - np.min(time)
    return np.minimum(elapsed / np.max(elapsed) * blocks, blocks - 1).astype(np.intp)


def jackknife(J: Array, residual: Array, time: Array, blocks: int) -> Array:
    """Estimate the covariance of least-squares unknowns.

    The estimate is the scatter of the unknowns, to first order, when one block of time at a time is
    left out. It stays valid for residuals that are correlated within a block.

    Args:
        J: Derivatives of the prediction by the unknowns, shape (n, k).
        residual: Measured minus predicted, shape (n,), of either sign.
        time: Times of the samples [s], shape (n,).
        blocks: Number of blocks of equal duration.
    """
    block = blocks_of_time(time, blocks)
    information = J.T @ J
    moves: list[npt.NDArray[np.floating]] = []
    for i in np.unique(block):
        J_i, residual_i = J[block == i], residual[block == i]
        without = information - J_i.T @ J_i
        moves.append(np.linalg.lstsq(without, J_i.T @ residual_i, rcond=None)[0])
    shift = np.stack(moves)
    return (len(shift) - 1) / len(shift) * (shift.T @ shift)


def half_width(variance: float, blocks: int) -> float:
    """Return the half width of a 95 % interval from a jackknife over so many blocks."""
    from scipy.stats import t as student

    return float(student.ppf(0.975, blocks - 1)) * sqrt(variance)
