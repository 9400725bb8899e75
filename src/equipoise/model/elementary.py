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

from equipoise.compiled import inlined, multiply_add

BATCH_SIZE: Final = 16
"""Number of states in a block: fills the widest registers and hides the latency of a division."""

TWO_OVER_PI: Final = 0.6366197723675814
# pi/2 in three parts of 53 bits.
HALF_PI_1: Final = 1.5707963267948966
HALF_PI_2: Final = 6.123233995736766e-17
HALF_PI_3: Final = -1.4973849048591833e-33


@inlined
def at(block: npt.NDArray[np.float64], row: int, n: int) -> float:
    """Return the entry of a block in a row, in lane `n`."""
    return block[row * BATCH_SIZE + n]


@inlined
def put(block: npt.NDArray[np.float64], row: int, n: int, value: float) -> None:
    """Write the entry of a block in a row, in lane `n`."""
    block[row * BATCH_SIZE + n] = value


@inlined
def fma(a: float, b: float, c: float) -> float:
    """Return a b + c with one rounding: one instruction, and the same bits on every machine.

    A compiler must not join a product and a sum by itself, because that changes the result.
    """
    return multiply_add(a, b, c)


@inlined
def sincos(x: float) -> tuple[float, float]:
    """Return sine and cosine of an angle below 1e6 rad, to two units in the last place.

    The angle is reduced by a multiple of pi/2 to within pi/4 (Cody and Waite; the first difference
    is exact); two polynomials (of degree 13 and 14, near minimax) give sine and cosine.
    """
    k = np.floor(fma(x, TWO_OVER_PI, 0.5))
    r = fma(-k, HALF_PI_3, fma(-k, HALF_PI_2, fma(-k, HALF_PI_1, x)))
    z = r * r
    s = fma(z, 1.58969099521155010221e-10, -2.50507602534068634195e-08)
    s = fma(z, s, 2.75573137070700676789e-06)
    s = fma(z, s, -1.98412698298579493134e-04)
    s = fma(z, s, 8.33333333332248946124e-03)
    s = fma(z, s, -1.66666666666666324348e-01)
    s = fma(r * z, s, r)
    c = fma(z, -1.13596475577881948265e-11, 2.08757232129817482790e-09)
    c = fma(z, c, -2.75573143513906633035e-07)
    c = fma(z, c, 2.48015872894767294178e-05)
    c = fma(z, c, -1.38888888888741095749e-03)
    c = fma(z, c, 4.16666666666666019037e-02)
    c = fma(z, fma(z, c, -0.5), 1.0)
    half_turns = np.floor(0.5 * k)
    if fma(-2.0, half_turns, k) != 0.0:  # an odd number of quarter turns
        s, c = c, -s
    if fma(-2.0, np.floor(0.5 * half_turns), half_turns) != 0.0:
        s, c = -s, -c
    return s, c
