"""The motion after a stop: the ramp over random states of an arm, and the way back in its reach."""

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.arm.iiwa import iiwa
from equipoise.errors import InputError
from equipoise.safety.rules import STOP_DECELERATION, check_setpoint, limits_of
from equipoise.safety.stop import SLOW_FRACTION, ramp, stoppable_speeds, way_back

ARM = iiwa(14)
LIMITS = limits_of(ARM)
HOME = ARM.home
DT = 0.005

fractions = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7)


def stream(way, n=None):
    """Return the setpoints from the begin of a ramp until after its end."""
    n = int(way.duration / DT) + 4 if n is None else n
    return np.array([way.at(i * DT).q for i in range(n)])


@given(fractions, st.floats(0.0, 2.0))
def test_the_arm_slows_down_at_once_goes_on_straight_and_ends_at_rest(fraction, speed):
    dq = [s * limit for s, limit in zip(fraction, LIMITS.velocity, strict=True)]
    way = ramp(HOME, dq, speed, LIMITS)
    q = stream(way)
    steps = np.diff(q, axis=0)
    moving = np.abs(dq) > 1e-6
    # In the very first step, every moving joint is slower than before.
    assert np.all(np.abs(steps[0])[moving] < np.abs(dq)[moving] * DT)
    assert np.all(np.abs(np.diff(np.abs(steps), axis=0)) >= -1e-15)
    # All joints in proportion, and none turns back.
    assert np.all(steps * np.array(dq) >= -1e-18)
    np.testing.assert_allclose(np.outer(steps[:, 0], dq), steps * dq[0], atol=1e-12)
    # Exactly at rest, and it stays.
    assert np.array_equal(q[-1], q[-2])
    assert way.at(1e9) == (tuple(q[-1]), pytest.approx((0.0,) * 7))


@given(fractions, st.floats(0.0, 2.0))
def test_each_setpoint_may_be_sent(fraction, speed):
    dq = [s * limit for s, limit in zip(fraction, LIMITS.velocity, strict=True)]
    way = ramp(HOME, dq, speed, LIMITS)
    last = HOME
    before = tuple(q - DT * v for q, v in zip(HOME, dq, strict=True))
    for setpoint in stream(way)[1:]:
        assert check_setpoint(LIMITS, tuple(setpoint), last, before, DT) is None
        before, last = last, tuple(setpoint)


@given(
    st.integers(0, 6), st.sampled_from([-1.0, 1.0]), st.floats(0.01, 0.3), st.floats(1e-9, 1.0),
    st.floats(0.0, 5.0),
)  # fmt: skip
def test_a_ramp_from_where_a_joint_can_just_be_stopped_ends_inside_its_limit(
    joint, side, fraction, before_the_last, flange_speed
):
    v = side * fraction * LIMITS.velocity[joint]
    limit = LIMITS.upper[joint] if side > 0.0 else LIMITS.lower[joint]
    farthest = limit - side * 0.5 * v * v / LIMITS.acceleration[joint]

    def at(place):
        return (*HOME[:joint], place, *HOME[joint + 1 :])

    # The farthest setpoint that may be sent, but for less than the way of one more.
    last = at(farthest - v * DT * before_the_last)
    before = at(last[joint] - v * DT)
    assert check_setpoint(LIMITS, last, before, at(before[joint] - v * DT), DT) is None
    dq = [(a - b) / DT for a, b in zip(last, before, strict=True)]
    for setpoint in stream(ramp(last, dq, flange_speed, LIMITS))[1:]:
        assert check_setpoint(LIMITS, tuple(setpoint), last, before, DT, to_rest=True) is None
        before, last = last, tuple(setpoint)


def test_a_ramp_begins_with_the_smaller_of_commanded_and_mean_speed():
    last, before = (0.01, 0.01, -0.01, -0.01, 0.5), (0.0, 0.0, 0.0, 0.0, 0.5)
    # Mean: 2, 2, -2, -2, 0 rad/s.
    dq = (3.0, 1.0, -3.0, -1.0, 0.1)
    assert stoppable_speeds(dq, last, before, DT) == pytest.approx((2.0, 1.0, -2.0, -1.0, 0.0))


def test_the_flange_slows_down_as_it_shall():
    # Along the track at home, as when balancing.
    J = ARM.kinematics(ARM.home_free).jacobian
    for x_dot in (0.05, 0.2, 0.4):
        dq = ARM.with_held(np.linalg.solve(J, np.eye(6)[0] * x_dot))
        dq[2] = 0.0
        way = ramp(HOME, dq, x_dot, LIMITS)
        assert min(way.rates) == pytest.approx(STOP_DECELERATION / x_dot)
        assert way.duration == pytest.approx(x_dot / STOP_DECELERATION)
        x = np.array([ARM.kinematics(ARM.without_held(q)).position[0] for q in stream(way)])
        # Where the flange comes to rest: v^2 / 2a, but for the bend of its path in joint space.
        assert x[-1] - x[0] == pytest.approx(x_dot**2 / (2 * STOP_DECELERATION), rel=0.02)
        half = map(ARM.without_held, way.at(0.5 * way.duration))
        speed = np.linalg.norm(ARM.kinematics(*half).twist[:3])
        assert speed == pytest.approx(0.5 * x_dot, rel=0.02)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("room", "rate"), [(0.5, 2.0), (0.08, 0.5 * 0.8 / 0.08), (0.01, 12.5), (0.0, 12.5), (-1, 12.5)]
)
def test_near_a_position_limit_it_stops_sooner(side, room, rate):
    q, dq = list(HOME), [0.0] * 7
    q[0] = side * (LIMITS.upper[0] - room)
    dq[0] = side * 0.8
    way = ramp(q, dq, 2.0, LIMITS)
    assert min(way.rates) == pytest.approx(rate)
    if room >= 0.08:
        assert abs(way.at(inf).q[0]) <= LIMITS.upper[0] + 1e-12
    # Away from the limit it does not matter.
    dq[0] = -dq[0]
    assert ramp(q, dq, 2.0, LIMITS).rates[0] == pytest.approx(2.0)


def test_a_joint_near_its_limit_does_not_wait_for_one_that_cannot_stop_so_soon():
    q, dq = list(HOME), [0.0] * 7
    dq[6] = 2.0  # stops in 0.2 s, and not sooner
    q[0], dq[0] = LIMITS.upper[0] - 0.02, 0.5  # would go 0.05 rad meanwhile
    way = ramp(q, dq, 0.0, LIMITS)
    assert way.rates[6] == pytest.approx(10.0 / 2.0)
    assert way.at(inf).q[0] == pytest.approx(LIMITS.upper[0])
    assert way.at(inf).q[6] == pytest.approx(HOME[6] + 2.0**2 / (2 * 10.0))
    assert way.at(0.1).dq[0] == 0.0
    assert way.at(0.1).dq[6] == pytest.approx(1.0)
    assert way.duration == pytest.approx(0.2)
    assert np.all(stream(way) <= np.array(LIMITS.upper) + 1e-12)


def test_at_rest_it_holds():
    way = ramp(HOME, (0.0,) * 7, 0.3, LIMITS)
    assert way.duration == 0.0
    for time in (-1.0, 0.0, DT, 10.0):
        assert way.at(time) == (HOME, (0.0,) * 7)


def test_it_starts_from_numbers():
    with pytest.raises(InputError, match="expected finite numbers"):
        ramp((*HOME[:6], nan), (0.0,) * 7, 0.0, LIMITS)


# The way back.

SLIDING = tuple(0.2 * limit for limit in LIMITS.velocity)
"""Velocities of a stop that covers 0.02 to 0.05 rad in each joint [rad/s]."""


def test_the_way_back_ends_where_the_arm_is():
    stop = ramp(HOME, SLIDING, 0.5, LIMITS)
    rest = stop.at(inf).q
    measured = tuple(0.4 * a + 0.6 * b for a, b in zip(HOME, rest, strict=True))
    q = stream(way_back(stop, rest, measured, LIMITS))
    assert q[0] == pytest.approx(rest)
    assert q[-1] == pytest.approx(measured)
    dq, ddq = np.diff(q, axis=0) / DT, np.diff(q, n=2, axis=0) / DT**2
    used = np.abs(dq / LIMITS.velocity).max(), np.abs(ddq / LIMITS.acceleration).max()
    assert max(used) == pytest.approx(SLOW_FRACTION, rel=0.05)


@given(
    fractions, st.lists(st.floats(-10.0, 10.0), min_size=7, max_size=7), st.integers(1, 400)
)  # fmt: skip
def test_no_setpoint_leaves_the_reach_of_the_ramp_whatever_is_measured(fraction, away, held_after):
    dq = [0.3 * s * limit for s, limit in zip(fraction, LIMITS.velocity, strict=True)]
    stop = ramp(HOME, dq, 0.5, LIMITS)
    rest = stop.at(inf).q
    way = way_back(stop, rest, np.add(HOME, away).tolist(), LIMITS)
    # A way back that is held brakes its joints at once.
    held = ramp(*way.at(held_after * DT), 0.0, LIMITS)
    back = [*stream(way, held_after + 1), *stream(held)[1:]]
    reach = np.abs(np.subtract(rest, HOME))
    assert (np.abs(np.array(back) - HOME) <= reach + 1e-12).all()
    assert np.array_equal(back[-1], back[-2])
    limits = LIMITS._replace(acceleration=tuple(1.001 * a for a in LIMITS.acceleration))
    for before, last, q in zip([back[0], *back], back, back[1:], strict=False):
        assert check_setpoint(limits, q, last, before, DT, to_rest=True) is None


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_way_back_stays_inside_the_limits(side):
    ends = np.array(LIMITS.upper if side > 0 else LIMITS.lower)
    q = tuple((ends - side * 0.01).tolist())
    stop = ramp(q, tuple(-side * v for v in SLIDING), 0.5, LIMITS)
    rest = stop.at(inf).q
    assert (np.abs(np.subtract(rest, q)) > 0.011).all()
    way = way_back(stop, rest, (ends + side * 0.01).tolist(), LIMITS)
    assert way.end == pytest.approx(ends, abs=1e-12)
