"""Lateness, round trips and an encoder's samples, in virtual time, where all of it is known."""

import threading

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.rig.checks.deadlines import burning, lateness
from equipoise.rig.checks.encoder import listen
from equipoise.rig.checks.link import connected, round_trips
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.interfaces import Sample
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder
from equipoise.robots.kst.robot import KstRobot
from tests.robots.kst.follower import HOME, Bench


class StallingClock:
    """Time that stalls: whoever waits over `at` wakes up `stall` later."""

    def __init__(self, at, stall, always=0.0):
        self.time, self.at, self.stall, self.always = 0.0, at, stall, always

    def now(self):
        return self.time

    def wait_until(self, moment):
        if moment <= self.time:
            return
        stalled = self.time < self.at <= moment
        self.time = moment + self.always + stalled * self.stall


def test_a_punctual_clock_is_never_late():
    late = lateness(VirtualClock(), 0.5)
    assert late.shape == (100,)
    np.testing.assert_allclose(late, 0.0, atol=1e-9)


def test_a_clock_that_always_wakes_late_does_not_drift():
    late = lateness(StallingClock(np.inf, 0.0, always=0.0003), 5.0)
    np.testing.assert_allclose(late, 0.0003, atol=1e-9)


def test_a_stall_makes_every_deadline_late_that_it_lasts_over():
    late = lateness(StallingClock(0.1, 0.023), 0.5)
    # The deadline at 0.1 s comes 23 ms late, and those 5, 10, 15, 20 ms behind it by what is left.
    np.testing.assert_allclose(late[19:24], (0.023, 0.018, 0.013, 0.008, 0.003), atol=1e-9)
    np.testing.assert_allclose(np.delete(late, range(19, 24)), 0.0, atol=1e-9)


def test_the_shortest_measurement_has_one_deadline():
    assert lateness(VirtualClock(), 0.0).shape == (1,)


class SlowRobot:
    """A robot that takes its time to answer, a list of times in turn."""

    joints = 7

    def __init__(self, clock, *times):
        self.clock, self.times, self.asked = clock, times, 0

    def measured(self):
        self.asked += 1
        self.clock.wait_until(self.clock.now() + self.times[self.asked % len(self.times)])
        return np.zeros(7)


def test_round_trips_are_what_the_robot_takes():
    clock = VirtualClock()
    robot = SlowRobot(clock, 0.001, 0.003)
    trips = round_trips(robot, clock, 1.0)
    assert trips.shape == (200,)
    assert robot.asked == 201
    np.testing.assert_allclose(np.unique(trips.round(6)), (0.001, 0.003))
    assert clock.now() == pytest.approx(1.0, abs=0.01)


def test_a_robot_slower_than_the_stream_is_asked_for_no_longer():
    clock = VirtualClock()
    trips = round_trips(SlowRobot(clock, 0.050), clock, 1.0)
    np.testing.assert_allclose(trips, 0.050)
    assert clock.now() < 1.2


def test_a_kst_robot_answers_through_its_server_and_does_not_move():
    bench = Bench(delay=0.002)
    robot = KstRobot(lambda: bench.client, bench.clock)
    with connected(robot):
        trips = round_trips(robot, bench.clock, 1.0)
    # Each way takes 2 ms; server and driver look once a millisecond.
    assert trips.min() >= 0.004 - 1e-9
    assert trips.max() <= 0.006 + 1e-9
    assert bench.body.targets == []
    assert bench.body.measured() == HOME
    assert bench.server.ended


class Spindle:
    """A board on a pipe of memory, with the sensor that listens."""

    def __init__(self, **board):
        self.clock = VirtualClock()
        self.theta = 0.0
        self.board = Board(lambda: self.theta, **board)
        host, self.device = memory_pipe(self.clock, 0.001)
        self.sensor = LineEncoder(lambda: host, self.clock)
        self.clock.attach(self.work)
        self.sensor.connect()

    def work(self, now):
        self.board.feed(self.device.read())
        self.device.write(self.board.advance(now))


def test_a_good_board_is_heard_at_its_rate():
    spindle = Spindle(counts_per_rev=4096, rate_hz=1000)
    heard = listen(spindle.sensor, spindle.clock, 2.0)
    assert heard.counts_per_rev == 4096
    assert heard.rate == pytest.approx(1000.0, abs=2.0)
    # A sample in each millisecond, less or more one at each end.
    assert heard.delay.n == pytest.approx(2000, abs=2)
    assert (heard.missing, heard.rejected, heard.illegal, heard.moved) == (0, 0, 0, 0)
    assert heard.age.most <= 0.0021
    assert heard.delay.most <= 0.0011


def test_what_is_lost_damaged_or_illegal_is_counted():
    spindle = Spindle()

    def disturb(now):
        if abs(now - trouble) < 1e-9:
            spindle.board.skip(7)
            spindle.board.meet_illegal()

    trouble = spindle.clock.now() + 0.3
    spindle.clock.attach(disturb)
    heard = listen(spindle.sensor, spindle.clock, 0.5)
    assert (heard.missing, heard.illegal) == (7, 1)
    assert heard.age.most >= 0.007
    spindle.board.malformed = 0.05
    heard = listen(spindle.sensor, spindle.clock, 2.0)
    # 2000 lines, one in twenty damaged; five standard deviations are 49.
    assert 51 <= heard.rejected <= 149
    assert heard.missing >= 51


def test_what_waited_before_anybody_listened_is_not_heard():
    spindle = Spindle()
    spindle.board.skip(7)
    spindle.clock.wait_until(spindle.clock.now() + 0.4)
    heard = listen(spindle.sensor, spindle.clock, 0.5)
    assert heard.delay.n == pytest.approx(500, abs=2)
    assert heard.missing == 0
    assert heard.delay.most <= 0.0011


def test_a_spindle_that_moves_is_noticed():
    spindle = Spindle(counts_per_rev=8192)
    begin = spindle.clock.now()
    spindle.clock.attach(lambda now: setattr(spindle, "theta", 0.1 * np.sin(6.0 * (now - begin))))
    heard = listen(spindle.sensor, spindle.clock, 2.0)
    assert heard.moved == pytest.approx(0.2 * 8192 / (2.0 * np.pi), abs=3)


class Mute:
    """A sensor that gives one sample and then none."""

    counts_per_rev = 2048
    rejected = 0

    def __init__(self):
        self.given = [Sample(0.0, 5, False, False, 0)]

    def samples(self):
        given, self.given = self.given, []
        return given


def test_without_samples_the_newest_gets_old():
    heard = listen(Mute(), VirtualClock(), 0.1)
    assert heard.delay is None
    assert heard.age.most == pytest.approx(0.1)
    assert heard.moved == 0


def test_burners_end_with_their_block():
    before = threading.active_count()
    with burning(2):
        assert threading.active_count() == before + 2
    assert threading.active_count() == before


class Door:
    """A device that notes what is done to it."""

    def __init__(self, fails=False):
        self.fails, self.done = fails, []

    def connect(self):
        self.done.append("connect")
        if self.fails:
            raise LinkError("nobody there; look")

    def close(self):
        self.done.append("close")


def test_a_device_is_let_go_of_whatever_happens():
    door = Door()
    with connected(door):
        door.done.append("use")
    assert door.done == ["connect", "use", "close"]
    door = Door(fails=True)
    with pytest.raises(LinkError, match="nobody there"), connected(door):
        pass
    assert door.done == ["connect", "close"]
    door = Door()
    with pytest.raises(LinkError), connected(door):
        raise LinkError("lost")
    assert door.done == ["connect", "close"]
