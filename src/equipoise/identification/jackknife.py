"""How far a fit can be trusted where its residuals hang together: leave blocks of time out."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.intp]


def blocks_of_time(time: Array, blocks: int) -> Whole:
    """Return which of so many blocks, of equal length in time, holds each sample, shape (n,)."""
    elapsed = time - time[0]
    return np.minimum(elapsed / elapsed[-1] * blocks, blocks - 1).astype(np.intp)


def jackknife(J: Array, residual: Array, block: Whole) -> Array:
    """Return the covariance of unknowns that leave the least squares.

    How far they move when one block is left out, taken to first order, says how far they can be
    trusted, also where the residuals within a block hang together.

    Args:
        J: Derivatives of the prediction by the unknowns, shape (n, k).
        residual: Measured minus predicted, shape (n,).
        block: The block of each, shape (n,).
    """
    information = J.T @ J
    moves: list[npt.NDArray[np.floating]] = []
    for i in np.unique(block):
        J_i, residual_i = J[block == i], residual[block == i]
        without = information - J_i.T @ J_i
        moves.append(np.linalg.lstsq(without, J_i.T @ residual_i, rcond=None)[0])
    shift = np.stack(moves)
    return (len(shift) - 1) / len(shift) * (shift.T @ shift)
