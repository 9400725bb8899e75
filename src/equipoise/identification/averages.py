"""Means of samples over short bins, and detection of single wrong samples.

Means over a fraction of a degree of the motion carry as much information about a pendulum as
millions of samples; the white noise averages out in both.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Averages(NamedTuple):
    """Means over bins of equal length in time; empty bins are left out."""

    time: Array
    """Mean time of the samples in each bin [s], shape (n,)."""
    values: Array
    """Mean value of the samples in each bin, in the recording's unit, shape (n,)."""
    spread: Array
    """Standard deviation of the times in each bin [s], shape (n,); zero for a single sample."""


def average(time: Array, values: Array, width: float) -> Averages:
    """Return the means of samples over bins.

    With fewer than two samples per bin, the samples are returned unchanged.

    Args:
        time: Time stamps [s], increasing, shape (n,).
        values: Recorded values, shape (n,).
        width: Length of the bins [s].
    """
    elapsed = time - time[0]
    bins = np.floor(elapsed / width)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    count = np.diff(first, append=len(time)).astype(np.float64)
    if len(time) < 2 * len(first):
        return Averages(time, values, np.zeros_like(time))
    middle = np.add.reduceat(elapsed, first) / count
    squares = (elapsed - np.repeat(middle, count.astype(np.intp))) ** 2
    return Averages(
        time[0] + middle,
        np.add.reduceat(values, first) / count,
        np.sqrt(np.add.reduceat(squares, first) / count),
    )


def spikes(values: Array, noise: float, resolution: float) -> npt.NDArray[np.bool_]:
    """Detect one or two adjacent samples that are far off their neighbours.

    Args:
        values: Recorded values, shape (n,).
        noise: Standard deviation of their noise, in the same unit.
        resolution: Smallest step of the sensor, in the same unit.

    Returns:
        Flags of wrong samples, shape (n,).
    """
    from scipy.ndimage import maximum_filter1d, median_filter

    smooth = np.asarray(median_filter(values, 5, mode="nearest"))
    off = np.abs(values - smooth)
    # A sparsely sampled motion changes as much between two samples.
    steps = maximum_filter1d(np.abs(np.diff(smooth, append=smooth[-1])), 9, mode="nearest")
    least = max(10.0 * noise, 6.0 * resolution, 0.02 * float(np.ptp(smooth)))
    return off > np.maximum(least, 2.0 * steps)
