"""Sine, cosine and logarithm to units in the last place, the same bits in every lane.

The witness sums the series of sine and cosine with 60 decimals (`decimal`), on any machine.
"""

from decimal import Decimal, localcontext
from fractions import Fraction
from math import inf, nextafter, pi, ulp

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.elementary import BATCH_SIZE, fma, log, sincos
from equipoise.jit import kernel

DIGITS = 60
PI = Decimal(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899863"
)
NEAR, LARGEST = 1e3, 1e6
"""Up to here two units in the last place, up to there three [rad]."""


def exact(x):
    """Return sine and cosine of a double with 50 decimals or more, relative to their size."""
    with localcontext() as context:
        context.prec = DIGITS
        angle = Decimal(x)
        quarter = PI / 2
        k = int((angle / quarter).to_integral_value())
        r = angle - k * quarter
        sine, cosine = _series(r, 1), _series(r, 0)
        return ((sine, cosine), (cosine, -sine), (-sine, -cosine), (-cosine, sine))[k % 4]


def _series(r, first):
    """Return r^first/first! - r^(first+2)/(first+2)! + ..."""
    total = term = r if first else Decimal(1)
    n = first
    while abs(term) > abs(total).scaleb(-DIGITS + 2):
        term *= -r * r / ((n + 1) * (n + 2))
        total += term
        n += 2
        if not term:
            break
    return total


def ulps(x):
    """Return the errors of sine and cosine of `x` in units of the last place of the true value."""
    return [
        abs(float((Decimal(float(got)) - true) / Decimal(ulp(float(true)))))
        for got, true in zip(sincos(x), exact(x), strict=True)
    ]


def worst(angles):
    """Return the largest error over angles, and the angle where it is."""
    return max((max(ulps(float(x))), float(x)) for x in angles)


@pytest.mark.parametrize(
    ("angles", "units"),
    [
        (np.linspace(-2 * pi, 2 * pi, 4001), 2.0),
        (np.random.default_rng(1).uniform(-10, 10, 2000), 2.0),
        (np.random.default_rng(2).uniform(-NEAR, NEAR, 4000), 2.0),
        (np.random.default_rng(3).uniform(-LARGEST, LARGEST, 2000), 3.0),
        (10 ** np.random.default_rng(4).uniform(-300, 0, 1000), 2.0),
        # The worst of ten million random angles: the reduction rounds twice in one direction.
        ([-9723.35457720195, -54052.547354895374, 45894.474770463596, 409540.9091188961], 3.0),
    ],
    ids=["dense", "near", "far", "farthest", "tiny", "worst"],
)
def test_sine_and_cosine_are_right_to_units_in_the_last_place(angles, units):
    assert worst(angles) < (units, inf)


def test_the_error_stays_relative_beside_multiples_of_a_quarter_turn():
    # There sine or cosine is almost zero, and all of its digits come from the reduction.
    k = np.unique(np.r_[1:200, np.random.default_rng(5).integers(200, LARGEST / (pi / 2), 600)])
    beside = [
        x
        for multiple in k * (pi / 2)
        for x in (nextafter(multiple, 0), float(multiple), nextafter(multiple, inf), -multiple)
    ]
    assert worst(beside) < (2.0, inf)


# Logarithm and fused multiply-add


@given(x=st.floats(2.0**-1000, 2.0**1000) | st.floats(0.5, 2.0))
def test_the_logarithm_is_right_to_a_unit_in_the_last_place(x):
    with localcontext() as context:
        context.prec = DIGITS
        true = Decimal(x).ln()
    assert abs(Decimal(float(log(x))) - true) <= Decimal(ulp(float(true)))


@kernel
def fused(a, b, c):
    """Return a b + c as kernels do it."""
    return fma(a, b, c)


@given(a=st.floats(-1e100, 1e100), b=st.floats(-1e100, 1e100), c=st.floats(-1e200, 1e200))
def test_a_product_and_a_sum_are_rounded_once(a, b, c):
    true = Fraction(a) * Fraction(b) + Fraction(c)
    assert fused(a, b, c) == float(true)


# Lanes


@kernel
def in_lanes(angles, out, lanes):
    """Write sines and cosines of a block's first lanes, as kernels do it."""
    for n in range(lanes):
        out[0, n], out[1, n] = sincos(angles[n])


@pytest.mark.parametrize("lanes", [0, 1, 7, BATCH_SIZE])
def test_an_angle_has_the_same_bits_in_any_lane_and_lanes_that_are_not_used_are_not_touched(lanes):
    rng = np.random.default_rng(6)
    for spread in (1.0, 10.0, 1e5) * 10:
        angles = rng.uniform(-spread, spread, BATCH_SIZE)
        alone = np.array([sincos(float(x)) for x in angles]).T
        out = np.full((2, BATCH_SIZE), np.nan)
        in_lanes(angles, out, lanes)
        # The bytes are compared: -0.0 == 0.0 would hide a difference.
        assert out[:, :lanes].tobytes() == alone[:, :lanes].tobytes()
        assert np.all(np.isnan(out[:, lanes:]))
