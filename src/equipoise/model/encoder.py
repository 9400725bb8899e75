"""Model of the incremental encoder on the pendulum's axis.

Counts are integers after x4 decoding. They increase with theta (sign = 1) or decrease (sign = -1).
A count represents the middle of its step, counts = floor(sign theta N / 2 pi + 1/2), so that the
quantization error of the angle is at most half a step, pi / N.
"""

from math import pi
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.jit import compilable

Numbers = TypeVar("Numbers", float, npt.NDArray[np.float64])
"""A number or an array."""


@compilable
def counts_from_theta(theta: Numbers, counts_per_rev: float, sign: float) -> Numbers:
    """Return the encoder counts at an angle.

    Args:
        theta: Angle from hanging [rad], a number or an array.
        counts_per_rev: Counts per revolution N.
        sign: 1 if counts increase with theta, -1 if they decrease.

    Returns:
        An integral number of counts.

    Example:
        >>> float(counts_from_theta(3.141592653589793, 4096, 1))
        2048.0
    """
    counts: Any = np.floor(sign * theta * counts_per_rev / (2.0 * pi) + 0.5)
    return counts


@compilable
def theta_from_counts(counts: Numbers, counts_per_rev: float, sign: float) -> Numbers:
    """Return the angle in the middle of a count's step [rad].

    Args:
        counts: Counts, a number or an array.
        counts_per_rev: Counts per revolution N.
        sign: 1 if counts increase with theta, -1 if they decrease.

    Example:
        >>> float(theta_from_counts(-1024, 4096, -1))
        1.5707963267948966
    """
    return sign * counts * 2.0 * pi / counts_per_rev
