"""Least-squares fits, and their covariance by a block jackknife for autocorrelated residuals."""

from collections.abc import Callable
from math import sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array

IntArray = npt.NDArray[np.intp]


def fit_unknowns(
    residual: Callable[[Array], Array],
    sensitivities: Callable[[Array], Array],
    start: Array,
    fitted: list[int],
    scales: Array,
    bounds: tuple[Array, Array],
    **options: Any,
) -> Array:
    """Return the unknowns with the least sum of squared residuals, shape (k,).

    Args:
        residual: Returns measured minus predicted of all unknowns, of any shape.
        sensitivities: Returns the derivatives of the prediction by the fitted unknowns, shape
            (n, number of fitted).
        start: Initial guess of all unknowns, shape (k,).
        fitted: Indices of the free unknowns.
        scales: Scale of each unknown, shape (k,).
        bounds: Lower and upper bounds of all unknowns, shape (k,) each.
        options: Tolerances and the like, for `scipy.optimize.least_squares`.
    """
    from scipy.optimize import least_squares

    scale = scales[fitted]
    low, high = (end[fitted] / scale for end in bounds)

    def at(x: Array) -> Array:
        unknowns = start.copy()
        unknowns[fitted] = x * scale
        return unknowns

    solution = least_squares(
        lambda x: -residual(at(x)).ravel(),
        np.clip(start[fitted] / scale, low + 1e-3, high - 1e-3),
        # SciPy's stub accepts a name here, but no function.
        jac=lambda x: sensitivities(at(x)) * scale,  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        x_scale="jac",
        **options,
    )
    return at(solution.x)


def blocks_of_time(time: Array, blocks: int) -> IntArray:
    """Return the index of the block of equal duration that holds each sample, shape (n,)."""
    elapsed = time - time[0]
    return np.minimum(elapsed / elapsed[-1] * blocks, blocks - 1).astype(np.intp)


def jackknife(J: Array, residual: Array, block: IntArray) -> Array:
    """Estimate the covariance of least-squares unknowns.

    The estimate is the scatter of the unknowns, to first order, when one block at a time is left
    out. It stays valid for residuals that are correlated within a block.

    Args:
        J: Derivatives of the prediction by the unknowns, shape (n, k).
        residual: Measured minus predicted, shape (n,).
        block: Index of the block of each sample, shape (n,).
    """
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
