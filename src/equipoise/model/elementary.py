"""Vectorised kernels: blocks of lanes, and sine and cosine as polynomials.

A processor computes several numbers with one instruction if straight-line code runs over adjacent
numbers. Therefore kernels advance a *block* of `BATCH_SIZE` independent states (episodes, trials)
together: row i of a block holds `BATCH_SIZE` adjacent numbers, entry (i, n) lies at
i * BATCH_SIZE + n, and each formula is the body of a loop over n. A call into a mathematics library
prevents vectorisation; the polynomials below do not. They also give identical bits in every lane of
a block, independent of the other lanes.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from equipoise.compiled import inlined

BATCH_SIZE: Final = 16
"""Number of states in a block: fills the widest registers and hides the latency of a division."""

TWO_OVER_PI: Final = 0.6366197723675814
# pi/2 in three parts; k * HALF_PI_1 is exact for |k| < 2^20.
HALF_PI_1: Final = 1.57079632673412561417e00
HALF_PI_2: Final = 6.07710050630396597660e-11
HALF_PI_3: Final = 2.02226624879595063154e-21


@inlined
def at(block: npt.NDArray[np.float64], row: int, n: int) -> float:
    """Return the entry of a block in a row, in lane `n`."""
    return block[row * BATCH_SIZE + n]


@inlined
def put(block: npt.NDArray[np.float64], row: int, n: int, value: float) -> None:
    """Write the entry of a block in a row, in lane `n`."""
    block[row * BATCH_SIZE + n] = value


@inlined
def sincos(x: float) -> tuple[float, float]:
    """Return sine and cosine of an angle below 1e6 rad, to two units in the last place.

    The angle is reduced by a multiple of pi/2 to within pi/4 (Cody and Waite), with its rounding
    error; two polynomials (of degree 13 and 14, near minimax) give sine and cosine.
    """
    k = np.floor(x * TWO_OVER_PI + 0.5)
    t = x - k * HALF_PI_1
    r = t - k * HALF_PI_2
    lost = ((t - r) - k * HALF_PI_2) - k * HALF_PI_3
    z = r * r
    s = 1.58969099521155010221e-10
    s = -2.50507602534068634195e-08 + z * s
    s = 2.75573137070700676789e-06 + z * s
    s = -1.98412698298579493134e-04 + z * s
    s = 8.33333333332248946124e-03 + z * s
    s = -1.66666666666666324348e-01 + z * s
    s = r + (r * z * s + lost * (1.0 - 0.5 * z))
    c = -1.13596475577881948265e-11
    c = 2.08757232129817482790e-09 + z * c
    c = -2.75573143513906633035e-07 + z * c
    c = 2.48015872894767294178e-05 + z * c
    c = -1.38888888888741095749e-03 + z * c
    c = 4.16666666666666019037e-02 + z * c
    c = 1.0 - (0.5 * z - (z * z * c - r * lost))
    quadrant = k - 4.0 * np.floor(0.25 * k)
    odd = quadrant == 1.0 or quadrant == 3.0
    sine = c if odd else s
    cosine = s if odd else c
    if quadrant >= 2.0:
        sine = -sine
    if quadrant == 1.0 or quadrant == 2.0:
        cosine = -cosine
    return sine, cosine
