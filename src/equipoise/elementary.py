"""Vectorised kernels: blocks of lanes; sine, cosine and logarithm as polynomials.

A processor computes several numbers with one instruction if straight-line code runs over adjacent
numbers. Therefore kernels advance a *block* of `BATCH_SIZE` independent states (episodes, trials)
together: a field of a record (`equipoise.arrays`) has shape (rows, BATCH_SIZE), and each formula is
the body of a loop over the lane n. A call into a mathematics library prevents vectorisation; the
polynomials below do not. They also give identical bits in every lane of a block, independent of the
other lanes.
"""

from typing import Final

import numpy as np

from equipoise.jit import fma, inlined

__all__ = ["BATCH_SIZE", "fma", "log", "sincos"]

BATCH_SIZE: Final = 16
"""Number of states in a block: fills the widest registers and hides the latency of a division."""

ROUNDING: Final = 1.5 * 2.0**52
"""A sum with this number has no fraction; the last bits of its mantissa are the whole number."""


@inlined
def sincos(x: float) -> tuple[float, float]:
    """Return sine and cosine of an angle below 1e6 rad, to two units in the last place.

    The angle is reduced by a multiple of pi/2 to within pi/4 (Cody and Waite; the first difference
    is exact); two polynomials (of degree 13 and 14, near minimax) give sine and cosine.
    """
    rounded = fma(x, 0.6366197723675814, ROUNDING)  # 2/pi
    k = rounded - ROUNDING
    r = fma(-k, 1.5707963267948966, x)  # pi/2 in three parts of 53 bits
    r = fma(-k, -1.4973849048591833e-33, fma(-k, 6.123233995736766e-17, r))
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
    quarters = np.float64(rounded).view(np.int64)
    if quarters & 1:
        s, c = c, -s
    if quarters & 2:
        s, c = -s, -c
    return s, c


@inlined
def log(x: float) -> float:
    """Return the natural logarithm of a positive normal number, to one unit in the last place.

    x is 2^k m with m between the roots of 1/2 and 2. With s = (m - 1) / (m + 1) the logarithm of m
    is 2 s + 2 s^3/3 + ..., a polynomial in s^2 (of degree 7, near minimax).
    """
    bits = np.float64(x).view(np.int64)
    k = (bits - 0x3FE6A09E667F3BCD) >> 52  # the bits of the root of 1/2; 52 are the mantissa's
    f = np.int64(bits - (k << 52)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    r = fma(z, 1.479819860511658591e-01, 1.531383769920937332e-01)
    r = fma(z, r, 1.818357216161805012e-01)
    r = fma(z, r, 2.222219843214978396e-01)
    r = fma(z, r, 2.857142874366239149e-01)
    r = fma(z, r, 3.999999999940941908e-01)
    r = fma(z, r, 6.666666666666735130e-01)
    half_square = 0.5 * f * f
    # log 2 in two parts; an exponent times the first is exact.
    rest = fma(s, fma(z, r, half_square), float(k) * 1.90821492927058770002e-10)
    return fma(float(k), 6.93147180369123816490e-01, f - (half_square - rest))
