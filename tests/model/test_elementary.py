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

from equipoise.jit import kernel
from equipoise.model.elementary import BATCH_SIZE, at, fma, log, put, sincos

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


def allowed(x):
    return 2.0 if abs(x) < NEAR else 3.0


def test_the_witness_agrees_with_closed_forms():
    root = Decimal(3).sqrt() / 2
    for x, sine, cosine in [(pi / 6, Decimal("0.5"), root), (pi / 3, root, Decimal("0.5"))]:
        assert abs(exact(x)[0] - sine) < Decimal("2e-16")
        assert abs(exact(x)[1] - cosine) < Decimal("2e-16")
    # pi as a double is 1.2246467991473532e-16 short of pi.
    assert float(exact(pi)[0]) == 1.2246467991473532e-16
    for x in (0.0, 1.0, -2.5, 100.0, 12345.678):
        sine, cosine = exact(x)
        assert abs(sine * sine + cosine * cosine - 1) < Decimal("1e-55")
        assert (float(sine), float(cosine)) == pytest.approx((np.sin(x), np.cos(x)), rel=1e-15)


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


def test_the_doubles_closest_to_a_multiple_of_a_quarter_turn_are_no_exception():
    k = np.arange(1, int(LARGEST / (pi / 2)))
    doubles = k * (pi / 2)
    # The distance k pi/2 - fl(k pi/2), with pi/2 in two parts: k times the first is exact.
    high = float.fromhex("0x1.921fb544p+0")
    low = float(PI / 2 - Decimal(high))
    distance = np.abs((k * high - doubles) + k * low)
    closest = doubles[np.argsort(distance)[:50]]
    assert abs(exact(float(closest[0]))[int(k[np.argmin(distance)]) % 2]) < Decimal("1e-15")
    assert worst(closest) < (2.0, inf)
    assert worst(-closest) < (2.0, inf)


def test_between_quadrants_nothing_jumps():
    for k in (1, 3, 5, 7, 1001):
        x = k * pi / 4
        for _ in range(50):
            assert max(ulps(x)) < 2.0
            x = nextafter(x, inf)


@given(x=st.floats(-LARGEST, LARGEST))
def test_sine_is_odd_and_cosine_even(x):
    (sine, cosine), (mirrored_sine, mirrored_cosine) = sincos(x), sincos(-x)
    assert max(*ulps(x), *ulps(-x)) < allowed(x)
    if abs(x) < pi / 4:
        assert (mirrored_sine, mirrored_cosine) == (-sine, cosine)


@given(x=st.floats(-LARGEST, LARGEST))
def test_the_point_is_on_the_unit_circle(x):
    sine, cosine = sincos(x)
    # An error of n units of the larger one, 2^-53 each, counts twice; then two roundings.
    assert abs(sine**2 + cosine**2 - 1.0) <= (4 * allowed(x) + 2) * 2**-53


def test_known_points_are_exact():
    assert sincos(0.0) == (0.0, 1.0)
    assert sincos(5e-324) == (5e-324, 1.0)
    assert sincos(pi / 2)[0] == 1.0
    assert sincos(pi)[1] == -1.0


# Logarithm and fused multiply-add


@given(x=st.floats(2.0**-1000, 2.0**1000) | st.floats(0.5, 2.0))
def test_the_logarithm_is_right_to_a_unit_in_the_last_place(x):
    with localcontext() as context:
        context.prec = DIGITS
        true = Decimal(x).ln()
    assert abs(Decimal(float(log(x))) - true) <= Decimal(ulp(float(true)))


def test_the_logarithm_of_powers_of_two_is_that_of_the_library():
    assert log(1.0) == 0.0
    assert [log(2.0**k) for k in range(-40, 40)] == [np.log(2.0**k) for k in range(-40, 40)]


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
        sine, cosine = sincos(at(angles, 0, n))
        put(out, 0, n, sine)
        put(out, 1, n, cosine)


def in_block(angles, lanes):
    out = np.full(2 * BATCH_SIZE, np.nan)
    in_lanes(np.ascontiguousarray(angles), out, lanes)
    return out.reshape(2, BATCH_SIZE)


@pytest.mark.parametrize("spread", [1.0, 10.0, 1e5])
def test_an_angle_has_the_same_bits_in_any_lane_alone_or_in_company(spread):
    rng = np.random.default_rng(6)
    for _ in range(50):
        angles = rng.uniform(-spread, spread, BATCH_SIZE)
        alone = np.array([sincos(float(x)) for x in angles]).T
        # The bytes are compared: -0.0 == 0.0 would hide a difference.
        assert in_block(angles, BATCH_SIZE).tobytes() == alone.tobytes()
        order = rng.permutation(BATCH_SIZE)
        assert in_block(angles[order], BATCH_SIZE).tobytes() == alone[:, order].tobytes()


@pytest.mark.parametrize("lanes", range(BATCH_SIZE + 1))
def test_lanes_that_are_not_used_are_not_touched(lanes):
    angles = np.linspace(-3.0, 3.0, BATCH_SIZE)
    out = in_block(angles, lanes)
    alone = np.array([sincos(float(x)) for x in angles]).T
    assert out[:, :lanes].tobytes() == alone[:, :lanes].tobytes()
    assert np.all(np.isnan(out[:, lanes:]))


def test_a_row_of_a_block_is_contiguous():
    numbers = np.zeros(3 * BATCH_SIZE)
    put(numbers, 2, 5, 7.0)
    assert np.flatnonzero(numbers).tolist() == [2 * BATCH_SIZE + 5]
    assert at(numbers, 2, 5) == 7.0
    assert at(numbers, 2, 4) == 0.0
