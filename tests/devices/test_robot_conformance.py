"""What every `Robot` does, whoever stands behind it.

A new one adds one line to ROBOTS: its name, and what makes it with the clock of its rig, not yet
connected. Everything here goes through the interface alone, so that it holds for hardware as well.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from equipoise.devices.interfaces import Clock, Robot
from equipoise.devices.kuka.robot import KstRobot
from equipoise.errors import EquipoiseError, InputError, LinkError
from tests.devices import in_process
from tests.devices.kuka.follower import Bench

PERIOD = 0.005
MOVE = 0.02  # how far the first joint is moved, and back [rad]
CLOSE = 2e-3  # what a servo with a soft dead band leaves after a second [rad]


def kst(**options):
    bench = Bench(**options)
    return KstRobot(lambda: bench.client, bench.clock), bench.clock


ROBOTS: dict[str, Callable[[], tuple[Robot, Clock]]] = {
    "KST": kst,
    "KST over a slow link": lambda: kst(delay=0.008),
    "twin": in_process.twin_robot,
    "model": in_process.model_robot,
}


class Rig:
    def __init__(self, robot, clock):
        self.robot, self.clock = robot, clock
        self.sent, self.replies = [], []

    def wait(self, duration):
        self.clock.wait_until(self.clock.now() + duration)

    def send(self, q, *, torque=False):
        self.sent.append((self.clock.now(), torque))
        self.robot.send(q, torque=torque)

    def stream(self, targets, torque_every=10**9):
        for i, q in enumerate(targets, start=1):
            self.send(q, torque=i % torque_every == 0)
            self.wait(PERIOD)
            self.replies += self.robot.replies()

    def drain(self):
        """Wait until each setpoint has its reply."""
        for _ in range(100):
            if len(self.replies) == len(self.sent):
                return
            self.wait(0.001)
            self.replies += self.robot.replies()
        pytest.fail(f"{len(self.sent)} setpoints, {len(self.replies)} replies")


def smooth(q, reach=MOVE, duration=0.5):
    """Setpoints along a minimum-jerk path of the first joint, and a second of rest at its end."""
    s = np.clip(np.arange(PERIOD, duration + 1.0, PERIOD) / duration, 0.0, 1.0)
    path = np.tile(q, (len(s), 1))
    path[:, 0] += reach * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return path


@pytest.fixture(params=ROBOTS.values(), ids=ROBOTS.keys())
def rig(request):
    rig = Rig(*request.param())
    yield rig
    rig.robot.close()


@pytest.fixture
def connected(rig):
    rig.robot.connect()
    return rig


@pytest.fixture
def started(connected):
    connected.home = connected.robot.measured()
    connected.robot.start()
    return connected


def test_it_is_a_robot(rig):
    assert isinstance(rig.robot, Robot)
    assert isinstance(rig.clock, Clock)


def test_joints_are_measured_before_the_servo_runs(connected):
    q = connected.robot.measured()
    assert q.shape == (connected.robot.joints,)
    assert np.isfinite(q).all()
    connected.wait(0.5)
    assert connected.robot.measured() == pytest.approx(q, abs=1e-4), "the arm is at rest"


def test_start_holds_the_arm_where_it_is(started):
    started.stream([started.home] * 40)
    started.drain()
    for reply in started.replies:
        assert reply.q == pytest.approx(started.home, abs=CLOSE)


def test_setpoints_are_followed(started):
    started.stream(smooth(started.home))
    started.drain()
    q = np.array([reply.q for reply in started.replies])
    assert q[-1] == pytest.approx([started.home[0] + MOVE, *started.home[1:]], abs=CLOSE)
    assert np.all(np.diff(q[:, 0]) > -5e-4), "there is no way back on the way"


def test_each_setpoint_has_its_reply_in_order_with_its_times(started):
    started.stream(smooth(started.home), torque_every=7)
    started.drain()
    assert [reply.sent for reply in started.replies] == [sent for sent, _ in started.sent]
    for reply, (_, torque) in zip(started.replies, started.sent, strict=True):
        values, other = (reply.torque, reply.q) if torque else (reply.q, reply.torque)
        assert other is None
        assert len(values) == started.robot.joints
        assert np.isfinite(values).all()
        assert reply.sent <= reply.received <= started.clock.now()
    received = [reply.received for reply in started.replies]
    assert received == sorted(received)


def test_there_is_no_reply_without_a_setpoint(started):
    assert started.robot.replies() == []
    started.stream([started.home] * 3)
    started.drain()
    started.wait(0.5)
    assert started.robot.replies() == []


def test_stop_leaves_the_arm_where_it_is_and_another_start_holds_it_there(started):
    started.stream(smooth(started.home))
    started.drain()
    there = started.replies[-1].q
    started.robot.stop()
    assert started.robot.measured() == pytest.approx(there, abs=CLOSE)
    started.wait(1.0)
    assert started.robot.measured() == pytest.approx(there, abs=CLOSE)
    started.robot.start()
    started.wait(0.5)
    started.stream([there])
    started.drain()
    assert started.replies[-1].q == pytest.approx(there, abs=CLOSE)


def test_setpoint_without_a_servo_is_refused(connected):
    q = connected.robot.measured()
    with pytest.raises(LinkError):
        connected.robot.send(q)
    assert connected.robot.measured() == pytest.approx(q, abs=1e-4)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_setpoint_that_is_not_finite_is_refused_and_not_sent(started, value):
    for i in range(started.robot.joints):
        q = started.home.copy()
        q[i] = value
        with pytest.raises(InputError):
            started.robot.send(q)
    still_streams(started)


@pytest.mark.parametrize("count", [-1, 1])
def test_setpoint_of_the_wrong_length_is_refused_and_not_sent(started, count):
    for q in ([0.0] * (started.robot.joints + count), []):
        with pytest.raises(InputError):
            started.robot.send(q)
        with pytest.raises(InputError):
            started.robot.send(np.array(q), torque=True)
    still_streams(started)


def still_streams(rig):
    """Nothing has been sent, and nothing is spoilt."""
    rig.wait(0.1)
    assert rig.robot.replies() == []
    rig.stream([rig.home] * 10)
    rig.drain()
    assert rig.replies[-1].q == pytest.approx(rig.home, abs=CLOSE)


def test_stop_without_a_servo_does_nothing(connected):
    connected.robot.stop()
    connected.robot.measured()


def test_close_may_be_called_again_and_nothing_works_after_it(started):
    started.robot.close()
    started.robot.close()
    with pytest.raises(LinkError):
        started.robot.send(started.home)
    for call in (started.robot.measured, started.robot.start):
        with pytest.raises(EquipoiseError):
            call()
    started.robot.close()


def test_close_without_connect_does_nothing(rig):
    rig.robot.close()
