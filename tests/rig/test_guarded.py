"""The guard around a robot: what leaves, whatever goes in. Limits are recomputed from the arm."""

from math import nan, radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.arm.iiwa import iiwa
from equipoise.errors import LinkError
from equipoise.outcomes import Outcome
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.guarded import GuardedRobot
from equipoise.safety.rules import FIRST_LIMIT, limits_of
from tests.rig.test_loop import Arm

ARM = iiwa(7)
HOME = np.array(ARM.home)
PERIOD = 0.005
LOWER = np.array([joint.lower for joint in ARM.joints]) + radians(3.0)
UPPER = np.array([joint.upper for joint in ARM.joints]) - radians(3.0)
VELOCITY = np.array([joint.velocity for joint in ARM.joints])
ACCELERATION = np.array([joint.acceleration for joint in ARM.joints])


def guarded(q=HOME):
    tape = Arm(VirtualClock(), q=q)
    robot = GuardedRobot(tape, limits_of(ARM), PERIOD)
    robot.start()
    return robot, tape


def along(start, velocity, n):
    """Setpoints of a stream that speeds up within the limits, to velocities [rad/s]."""
    q, dq = np.array(start, float), np.zeros(7)
    for _ in range(n):
        dq = dq + np.clip(velocity - dq, -0.9 * ACCELERATION * PERIOD, 0.9 * ACCELERATION * PERIOD)
        q = q + PERIOD * dq
        yield tuple(q)


def moving(speed=0.4, n=40):
    """A guarded arm that moves at a tenth to the half of its speed."""
    robot, tape = guarded()
    robot.send(HOME)
    for setpoint in along(HOME, speed * np.array([1.0, 0.2, 0.0, -0.5, 0.1, 0.3, -1.0]), n):
        robot.send(setpoint)
    assert robot.held_back is None
    return robot, tape


def check_sent(sent):
    q = np.array(sent)
    assert q.shape[1] == 7
    assert np.isfinite(q).all()
    assert (q >= LOWER - 1e-9).all()
    assert (q <= UPPER + 1e-9).all()
    steps = np.diff(q, axis=0, prepend=q[:1])
    assert (np.abs(steps) <= VELOCITY * PERIOD * (1.0 + 1e-5) + 1e-12).all()
    jolts = np.diff(steps, axis=0, prepend=np.zeros((1, 7)))
    assert (np.abs(jolts) <= ACCELERATION * PERIOD**2 * (1.0 + 1e-5) + 1e-12).all()


@pytest.mark.parametrize("away", [2.0 * FIRST_LIMIT, -0.1, nan])
def test_nothing_leaves_before_a_first_setpoint_where_the_arm_is(away):
    robot, tape = guarded()
    first = HOME.copy()
    first[4] += away
    with pytest.raises(LinkError, match="nothing was sent"):
        robot.send(first)
    assert tape.sent == []
    assert robot.held_back is not None
    assert robot.last is None
    robot.stop()
    assert robot.at_rest
    # It is for good: not even where the arm is may anything be sent now.
    with pytest.raises(LinkError, match="begin a new run"):
        robot.start()


def test_a_start_outside_the_limits_sends_nothing():
    with pytest.raises(LinkError, match=r"nothing was sent: the setpoint of joint 2 leads to"):
        guarded((HOME[0], UPPER[1] + 0.01, *HOME[2:]))


BAD = {
    "a number that is none": lambda q: (*q[:6], nan),
    "six numbers": lambda q: q[:6],
    "a jump": lambda q: tuple(a + 0.05 for a in q),
    "a velocity": lambda q: (*q[:6], q[6] + 0.02),
    "a position": lambda q: (q[0], 2.05, *q[2:]),
}


@pytest.mark.parametrize("name", BAD)
def test_a_setpoint_that_may_not_be_sent_is_replaced_by_the_next_of_a_ramp(name):
    robot, tape = moving()
    last = np.array(tape.sent[-1])
    speed = np.array(tape.sent[-1]) - np.array(tape.sent[-2])
    asked = len(tape.sent)
    robot.send(BAD[name](tuple(last + speed)))
    assert robot.held_back
    assert len(tape.sent) == asked + 1  # one for one: each setpoint has its reply
    assert robot.last == tape.sent[-1]
    step = np.array(tape.sent[-1]) - last
    moves = np.abs(speed) > 1e-9
    # It goes on the same way, and slower at once.
    assert (step * speed >= 0.0).all()
    assert (np.abs(step)[moves] < np.abs(speed)[moves]).all()
    check_sent(tape.sent)


def test_nothing_is_let_through_after_a_latched_stop():
    robot, tape = moving()
    robot.send((nan,) * 7)
    reason = robot.held_back
    good = list(along(tape.sent[-1], 0.1 * VELOCITY, 300))
    for setpoint in good:
        robot.send(setpoint)
    assert robot.held_back == reason  # the first one stays
    assert robot.at_rest
    assert tape.sent[-1] == tape.sent[-2]
    assert not set(good) & set(tape.sent)
    check_sent(tape.sent)


def test_a_stop_ramps_from_what_was_sent_last():
    robot, tape = moving()
    robot.stop()
    while not robot.at_rest:
        robot.send(())
        assert tape.sent[-1] == robot.last
    assert robot.held_back is None  # nothing was wrong
    # The end of a ramp is where it stays, and there is no second one.
    robot.send(HOME)
    assert tape.sent[-1] == tape.sent[-2]
    robot.stop()
    assert robot.at_rest
    check_sent(tape.sent)


wild = st.one_of(st.floats(), st.floats(-3.0, 3.0))


@given(
    start=st.lists(st.floats(0.02, 0.98), min_size=7, max_size=7),
    fractions=st.lists(
        st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7), min_size=1, max_size=4
    ),
    late=st.integers(0, 200),
    bad=st.lists(wild, min_size=5, max_size=9),
)
def test_whatever_goes_in_what_leaves_keeps_all_limits(start, fractions, late, bad):
    at = LOWER + np.array(start) * (UPPER - LOWER)
    robot, tape = guarded(at)
    robot.send(at)
    q = at
    for fraction in fractions:
        for setpoint in along(q, np.array(fraction) * VELOCITY, 30):
            robot.send(setpoint)
            q = np.array(setpoint)
    robot.send(bad)
    for _ in range(late):
        robot.send(q)
    robot.stop()
    while not robot.at_rest:
        robot.send(())
    check_sent(tape.sent)
    assert robot.held_back is None or robot.at_rest


def test_a_stream_that_stood_still_begins_anew_from_rest():
    robot, tape = moving()
    last, before = np.array(tape.sent[-1]), np.array(tape.sent[-2])
    # The moving arm may go on so; the one that has come to rest meanwhile may not.
    robot.send(tuple(2.0 * last - before), from_rest=True)
    assert robot.held_back.outcome is Outcome.ACCELERATION
    assert np.array_equal(tape.sent[-1], last)
    robot, tape = moving()
    for n, setpoint in enumerate(along(tape.sent[-1], 0.4 * np.ones(7), 10)):
        robot.send(setpoint, from_rest=n == 0)
    assert robot.held_back is None
