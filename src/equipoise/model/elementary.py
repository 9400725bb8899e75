"""Vectorised kernels: blocks of lanes; sine, cosine and logarithm as polynomials.

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

CACHE_LINE: Final = 64
"""Size of a cache line [bytes], and of the widest registers."""
JOINT_BLOCK: Final = 6 * BATCH_SIZE
"""Size of a block of 6 rows, one for each free joint. A formula that is equal for all joints is one
loop over it, unused lanes included: a short loop costs more by its begin and end than by its body.
"""

TWO_OVER_PI: Final = 0.6366197723675814
# pi/2 in three parts; k * HALF_PI_1 is exact for |k| < 2^20.
HALF_PI_1: Final = 1.57079632673412561417e00
HALF_PI_2: Final = 6.07710050630396597660e-11
HALF_PI_3: Final = 2.02226624879595063154e-21
NEAR_ANGLE: Final = 0.78
"""Angle below which `near_sincos` may be called [rad]: within pi/4, for which k is zero."""

# ln 2 in two parts; k * LN_2_1 is exact for the exponents k of all numbers.
LN_2_1: Final = 6.93147180369123816490e-01
LN_2_2: Final = 1.90821492927058770002e-10
SQRT_HALF_BITS: Final = 0x3FE6A09E667F3BCD
"""Bits of the square root of 1/2."""
MANTISSA: Final = 52
"""Number of bits of a mantissa."""


def zeros(count: int) -> npt.NDArray[np.float64]:
    """Return an array of zeros that begins on a cache line.

    Of registers as wide as a cache line, each that is loaded from elsewhere or stored touches two.
    """
    size = np.dtype(np.float64).itemsize * count
    room = np.zeros(size + CACHE_LINE, np.uint8)
    first = -room.ctypes.data % CACHE_LINE
    return room[first : first + size].view(np.float64)


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
    s, c = _sine_cosine(r, lost)
    quadrant = k - 4.0 * np.floor(0.25 * k)
    odd = quadrant == 1.0 or quadrant == 3.0
    sine = c if odd else s
    cosine = s if odd else c
    if quadrant >= 2.0:
        sine = -sine
    if quadrant == 1.0 or quadrant == 2.0:
        cosine = -cosine
    return sine, cosine


@inlined
def near_sincos(x: float) -> tuple[float, float]:
    """Return the bits of `sincos` for an angle within NEAR_ANGLE, with half the operations."""
    return _sine_cosine(x, 0.0)


@inlined
def _sine_cosine(r: float, lost: float) -> tuple[float, float]:
    """Return sine and cosine of r + lost, r within pi/4 and `lost` its rounding error."""
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
    return s, 1.0 - (0.5 * z - (z * z * c - r * lost))


@inlined
def logarithm(x: float) -> float:
    """Return the natural logarithm of a positive normal number, to one unit in the last place.

    x = 2^k (1 + f) with 1 + f from sqrt(1/2) to sqrt(2); with s = f / (2 + f), log(1 + f) is
    2 artanh(s): f - s (f - p), p a polynomial of degree 14 in s, near minimax (Ng, fdlibm).
    """
    bits = np.float64(x).view(np.int64)
    exponent = (bits - SQRT_HALF_BITS) >> MANTISSA
    f = np.int64(bits - (exponent << MANTISSA)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    p = 1.479819860511658591e-01
    p = 1.531383769920937332e-01 + z * p
    p = 1.818357216161805012e-01 + z * p
    p = 2.222219843214978396e-01 + z * p
    p = 2.857142874366239149e-01 + z * p
    p = 3.999999999940941908e-01 + z * p
    p = z * (6.666666666666735130e-01 + z * p)
    k, half = float(exponent), 0.5 * f * f
    return k * LN_2_1 - ((half - (s * (half + p) + k * LN_2_2)) - f)
