"""Measured joints that an arm can have, and disturbances that repeat."""

from math import inf, nan, pi

import numpy as np
import pytest

from equipoise.arm.iiwa import iiwa
from equipoise.safety.monitors import REPEAT_WINDOW, JointPlausibility, RepeatMonitor
from equipoise.safety.rules import limits_of

ARM = iiwa(7)
LIMITS, HOME = limits_of(ARM), np.array(ARM.home)
PERIOD, TRIP = 0.005, 0.004
COMMANDED = np.tile(HOME, (64, 1))


def doubt(course, n=100, trip=TRIP, commanded=COMMANDED):
    """Return the doubt about an arm whose replies follow a course, joints from home over time."""
    plausibility, q = JointPlausibility(LIMITS), tuple(HOME)
    for k in range(n):
        sent = k * PERIOD
        q = tuple((HOME + course(sent + 0.5 * trip)).tolist())
        plausibility.add(sent, sent + trip, q)
    return plausibility.doubt(q, commanded)


def only(joint, angle):
    return np.array([angle if i == joint else 0.0 for i in range(7)])


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_arm_that_moves_as_fast_and_as_hard_as_it_can_is_plausible(joint, sign):
    v, a = LIMITS.velocity[joint], LIMITS.acceleration[joint]
    # To and fro between its largest velocities, at its largest acceleration.
    w = a / v
    there = COMMANDED + np.linspace(-1, 1, 64)[:, None] * only(joint, v / w + 0.01)
    assert doubt(lambda t: sign * only(joint, v / w * np.sin(w * t)), 400, commanded=there) == ""


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("rate", [3.5, 10.0, -10.0, 100.0])
def test_joints_that_run_off_are_not_plausible(joint, rate):
    for begin in (0.2, 0.47):
        assert doubt(lambda t, at=begin: only(joint, np.clip(rate * max(t - at, 0.0), -1.5, 1.5)))


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("trip", [0.0, 0.004, 0.012])
def test_a_step_is_as_large_as_acceleration_noise_and_uncertain_times_allow(joint, trip):
    # From rest: five times the acceleration of setpoints; ten times the noise, and half a round
    # trip at the joint's velocity, at either end of either step.
    v, a = LIMITS.velocity[joint], LIMITS.acceleration[joint]
    most = 4.0 * (5e-4 + 0.5 * trip * v) + 5.0 * a * PERIOD**2
    most = min(most, 2.0 * (5e-4 + 0.5 * trip * v) + v * PERIOD)
    there = COMMANDED + np.linspace(0.0, 1.0, 64)[:, None] * only(joint, 0.1)
    for fraction, plausible in ((0.995, True), (1.005, False)):
        step = only(joint, fraction * most)
        course = lambda t, step=step: step * (t > 0.5 * trip + 3.5 * PERIOD)  # noqa: E731
        assert (doubt(course, 5, trip, there) == "") is plausible


def test_noise_and_uncertain_times_are_plausible():
    random = np.random.default_rng(0)
    plausibility, v = JointPlausibility(LIMITS), 0.9 * LIMITS.velocity[3]
    measured = received = 0.0
    for k in range(400):
        sent = k * PERIOD
        received = max(sent + random.uniform(0.001, 0.02), received)
        measured = random.uniform(max(sent, measured), received)
        q = HOME + only(3, 0.1 * np.sin(v / 0.1 * measured)) + 5e-5 * random.standard_normal(7)
        plausibility.add(sent, received, tuple(q.tolist()))
    assert plausibility.doubt(tuple(HOME), COMMANDED) == ""


def test_a_posture_that_was_not_commanded_is_not_plausible():
    assert doubt(lambda t: only(4, 0.03 * 0.999)) == ""
    assert "joint 5 is 0.031 rad from all of its last setpoints" in doubt(lambda t: only(4, 0.031))
    assert doubt(lambda t: only(4, -0.031))
    commanded = COMMANDED + np.linspace(0.0, 1.0, 64)[:, None] * only(4, 0.1)
    assert doubt(lambda t: only(4, 0.129), commanded=commanded) == ""


def test_a_few_replies_are_not_enough():
    assert doubt(lambda t: only(0, 0.0), 5) == ""
    assert "4 replies" in doubt(lambda t: only(0, 0.0), 4)


@pytest.mark.parametrize("number", [nan, inf, -inf, 2.0 * pi])
def test_joints_that_are_no_numbers_or_far_away_are_not_plausible(number):
    assert doubt(lambda t: only(1, number if t > 0.3 else 0.0))


def test_replies_out_of_order_are_not_plausible():
    plausibility = JointPlausibility(LIMITS)
    for sent in (0.0, 0.005, 0.010, 0.005, 0.015, 0.020):
        plausibility.add(sent, sent + TRIP, tuple(HOME))
    assert plausibility.doubt(tuple(HOME), COMMANDED)


# Disturbances.


@pytest.mark.parametrize(
    ("times", "often"),
    [
        ([3.0], []),
        # The third within a second stops, and one after it does not.
        ([0.0, 0.5, 1.0], [1.0]),
        ([0.0, 0.5, 1.0 + 1e-9], []),
        # In any window of a second, and again.
        ([0.0, 0.6, 0.5 + REPEAT_WINDOW, 0.59 + REPEAT_WINDOW], [0.59 + REPEAT_WINDOW]),
        ([9.0, 9.1, 9.2, 9.3], [9.2, 9.3]),
    ],
)
def test_two_within_a_second_are_bridged_and_no_more(times, often):
    monitor = RepeatMonitor()
    assert [time for time in times if monitor.add(time)] == often


def test_a_time_that_is_no_number_is_one_too_many():
    assert RepeatMonitor().add(nan)
