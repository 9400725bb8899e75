"""Block jackknife: covariance of a least-squares fit with autocorrelated residuals."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]


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
