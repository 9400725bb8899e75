"""Conformance suites of robots and simulated worlds, for tests of external ones.

A driver's test implements `make`; pytest collects the tests by name::

    from equipoise.testing import RobotConformance, emulated_robot


    class TestMyRobot(RobotConformance):
        def make(self):
            return emulated_robot("acme")

The tests of this package use the same classes. They go through the interfaces alone, so that they
hold for hardware as well: the first joint moves by 0.05 rad, at up to 0.16 rad/s.
"""

from collections.abc import Callable, Container, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from itertools import count
from math import nan, pi
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.testing import assert_allclose, assert_raises

from equipoise.arrays import Array
from equipoise.errors import EquipoiseError, InputError, LinkError
from equipoise.model.grid import ANGLE, TRUNCATED
from equipoise.model.pendulum import shipped_pendulum
from equipoise.rig.clocks import ended_stalls
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig
from equipoise.rig.interfaces import SETPOINT_PERIOD, Clock, Reply, Robot
from equipoise.simulation import ClosedLoop, Setup, Simulation, predicted

CLOSE: Final = 2e-3
"""Error of position that a servo with a soft dead band leaves after a second [rad]."""
STILL: Final = 5e-4
"""Noise of a measured joint, and motion of an arm at rest, at most [rad]."""
MAX_AGE: Final = 0.02
"""Maximum age of measured joints when their setpoint is sent [s]: a little more than the round trip
after which a run no longer uses them."""
MISREAD: Final = 0.1
"""Error of the first joint in a wrong reply [rad]."""
SILENCE: Final = 2.0
"""Maximum time until a driver reports a silent link [s]."""


class RobotUnderTest(NamedTuple):
    """A robot with what its conformance suite needs."""

    robot: Robot
    """The robot, not connected, its arm at rest."""
    clock: Clock
    """Clock of its rig."""
    plug: Callable[[bool], object]
    """Pulls the cable of the link (False), or puts it back (True)."""
    true_joints: Callable[[], Array] | None = None
    """Returns the joints from another source than the driver [rad], shape (joints,); None without
    one, as on most hardware."""
    misread: Callable[[Container[int]], object] | None = None
    """Makes readings of the joints wrong, by their numbers from now on, from one (`misreads`); None
    skips the tests with wrong replies."""


def misreads(body: Any) -> Callable[[Container[int]], None]:
    """Return `RobotUnderTest.misread` of an emulated arm, whose `measured()` it replaces."""
    measured, number = body.measured, count(1)
    wrong: Container[int] = ()

    def read() -> tuple[float, ...]:
        q = measured()
        return (q[0] + MISREAD, *q[1:]) if next(number) in wrong else q

    def misread(numbers: Container[int]) -> None:
        nonlocal wrong, number
        wrong, number = numbers, count(1)

    body.measured = read
    return misread


def emulated_robot(scheme: str) -> RobotUnderTest:
    """Return a robot in front of its emulator, on the twin `twin:nominal` in virtual time.

    Args:
        scheme: Scheme of its addresses. Its plugin has to give the emulator's end of the link.

    Raises:
        InputError: The robot has no emulator.
    """
    rig = emulated_rig("twin:nominal", RigSettings(), shipped_pendulum(), robot=scheme)
    assert rig.emulated is not None
    assert rig.bench is not None
    link, bench = rig.emulated[0].link, rig.bench
    assert link is not None, "the suite pulls the cable of the emulator: give Emulated.link"

    def plug(connected: bool) -> None:
        link.cut = link.other.cut = not connected

    rig.clock.wait_until(3.0)  # the pendulum has pulled the arm down

    def true_joints() -> Array:
        return np.array(bench.twin.data.qpos[: bench.joints])

    return RobotUnderTest(rig.robot, rig.clock, plug, true_joints, misreads(bench.body))


class RobotConformance:
    """Tests of a `Robot`."""

    def make(self) -> RobotUnderTest:
        """Return a new robot at rest, not connected, and the rig around it."""
        raise NotImplementedError

    def prepare(self) -> Robot:
        """Make the robot of a test."""
        self.robot, self.clock, self.plug, self.true_joints, self.misread = self.make()
        self.context = ExitStack()
        self.context.enter_context(ended_stalls(self.clock, self.clock, self.robot))
        self.context.callback(self.robot.close)
        return self.robot

    def teardown_method(self) -> None:
        """Close the robot, whatever failed."""
        if hasattr(self, "context"):
            self.context.close()

    def begin(self) -> Array:
        """Connect, start the servo, and return the measured joints [rad], shape (joints,)."""
        self.prepare().connect()
        home = self.measured()
        self.robot.start()
        return home

    def measured(self) -> Array:
        """Return the measured joints [rad], shape (joints,), if the arm is there."""
        q = self.robot.measured()
        assert np.shape(q) == (self.robot.joints,), f"{self.robot.joints} joints, measured {q}"
        if self.true_joints is not None:
            _same_joints(q, self.true_joints())
        return q

    def wait(self, seconds: float) -> None:
        """Wait [s]."""
        self.timed(self.clock.wait_until, self.clock.now() + seconds, over=seconds)

    def timed(self, call: Callable[..., Any], *arguments: Any, over: float = 0.0) -> Any:
        """Return the result of a call that must not block for longer than a time [s]."""
        began = self.clock.now()
        result = call(*arguments)
        took = self.clock.now() - began - over
        assert took < 0.1, f"{call.__name__} took {took:.3g} s too long: the driver blocks"
        return result

    def stream(self, setpoints: Iterable[Any]) -> tuple[list[float], list[Reply]]:
        """Send setpoints [rad], one each period; return their times [s] and their replies."""
        sent, replies, track = list[float](), list[Reply](), list[tuple[float, Array]]()

        def look(seconds: float) -> None:
            self.wait(seconds)
            replies.extend(self.timed(self.robot.replies))
            if self.true_joints is not None:
                track.append((self.clock.now(), self.true_joints()))

        for q in setpoints:
            sent.append(self.clock.now())
            self.timed(self.robot.send, q)
            look(SETPOINT_PERIOD)
        for _ in range(100):
            if len(replies) < len(sent):
                look(0.001)
        assert len(replies) == len(sent), f"{len(sent)} setpoints have {len(replies)} replies"
        for reply in replies:
            parts = [part for part in (reply.q, reply.torque) if part is not None]
            assert parts, "a reply has neither joints nor torques"
            assert {len(part) for part in parts} == {self.robot.joints}
            assert np.isfinite(parts).all(), f"a reply is not finite: {reply}"
            assert reply.sent <= reply.received, f"a reply is from before its setpoint: {reply}"
            if reply.q is not None:
                _measured_on_the_way(reply, track)
        return sent, replies

    def follow(self, setpoints: Iterable[Any]) -> Array:
        """Send setpoints [rad]; return the measured joints of their replies [rad]."""
        _, replies = self.stream(setpoints)
        return np.array([reply.q for reply in replies if reply.q is not None])

    def test_it_is_a_robot_and_its_joints_are_measured_before_the_servo_runs(self) -> None:
        robot = self.prepare()
        assert isinstance(robot, Robot)
        robot.close()  # without connect it does nothing
        robot.connect()
        q = self.measured()
        self.wait(0.5)
        _same_joints(self.measured(), q, STILL)
        assert_raises(LinkError, robot.send, q)  # no servo runs
        robot.stop()  # without a servo it does nothing
        _same_joints(self.measured(), q, STILL)

    def test_setpoints_are_followed_without_a_way_back(self) -> None:
        home = self.begin()
        _same_joints(self.follow([home] * 40)[-1], home)
        path = _path(home)
        q = self.follow(path)
        _same_joints(q[-1], path[-1])
        assert np.diff(q[:, 0]).min() > -STILL, "the joint went back on its way"

    def test_the_last_setpoint_is_reached_although_no_other_follows(self) -> None:
        home = self.begin()
        there = self.follow([home] * 40)[-1] + 5.0 * CLOSE
        self.robot.send(there)
        self.wait(1.0)
        self.robot.stop()
        _same_joints(self.measured(), there)

    def test_each_setpoint_has_its_reply_in_order_with_its_times(self) -> None:
        home = self.begin()
        assert self.robot.replies() == [], "a reply came without a setpoint"
        sent, replies = self.stream(_path(home))
        self.wait(0.5)
        assert self.robot.replies() == [], "a setpoint has two replies"
        assert [reply.sent for reply in replies] == sent, "replies are not in order"
        received = [reply.received for reply in replies]
        assert received == sorted(received), "the times of replies decrease"
        assert received[-1] <= self.clock.now(), "a reply is from the future"
        assert any(reply.torque for reply in replies), "torques never came"

    def test_stop_leaves_the_arm_where_it_is_and_another_start_holds_it_there(self) -> None:
        there = self.follow(_path(self.begin()))[-1]
        self.robot.stop()
        _same_joints(self.measured(), there)
        self.wait(1.0)
        _same_joints(self.measured(), there)
        self.robot.start()
        self.wait(0.5)
        _same_joints(self.follow([there] * 2)[-1], there)

    def test_a_wrong_setpoint_is_refused_and_not_sent(self) -> None:
        home = self.begin()
        robot, n = self.robot, self.robot.joints
        for i in range(n):
            assert_raises(InputError, robot.send, np.where(np.arange(n) == i, nan, 0.0))
        for length in (0, n - 1, n + 1):
            assert_raises(InputError, robot.send, [0.0] * length)
        self.wait(0.1)
        assert robot.replies() == [], "a refused setpoint has a reply"
        _same_joints(self.follow([home] * 10)[-1], home)

    def test_a_single_wrong_reply_at_the_start_does_not_move_the_arm(self) -> None:
        for number in range(1, 4):
            self.prepare().connect()
            self.not_misled({number}, self.robot.start)
            self.teardown_method()

    def test_wrong_replies_do_not_move_an_arm_that_is_held(self) -> None:
        home = self.begin()
        self.follow([home] * 10)
        self.not_misled(range(1, 10**6), self.robot.send, home)

    def not_misled(self, wrong: Container[int], act: Callable[..., Any], *setpoint: Array) -> None:
        """Start, or send a setpoint [rad]; the arm must not move because of wrong replies."""
        if self.misread is None or self.true_joints is None:
            return
        before, moved = self.true_joints(), 0.0
        self.misread(wrong)
        with suppress(LinkError):  # to refuse is right
            act(*setpoint)
            for _ in range(200):
                self.wait(0.001)
                moved = max(moved, float(np.abs(self.true_joints() - before).max()))
        # A servo that starts lets the arm sag.
        assert moved <= 5.0 * CLOSE, f"wrong replies moved the arm by {moved:.2g} rad"

    def test_close_may_be_called_again_and_nothing_works_after_it(self) -> None:
        home = self.begin()
        self.robot.close()
        self.robot.close()
        assert_raises(LinkError, self.robot.send, home)
        for call in (self.robot.measured, self.robot.start):
            assert_raises(EquipoiseError, call)

    def test_without_its_peer_it_does_not_connect(self) -> None:
        robot = self.prepare()
        self.plug(False)
        assert_raises(LinkError, robot.connect)

    def test_a_link_that_fails_at_rest_stays_failed(self) -> None:
        robot = self.prepare()
        robot.connect()
        self.plug(False)
        began = self.clock.now()
        assert_raises(LinkError, robot.measured)
        took = self.clock.now() - began
        assert took <= SILENCE, f"a pulled cable is reported after {took:.3g} s"
        self.stays_failed()

    def test_a_link_that_fails_in_the_stream_stays_failed(self) -> None:
        home = self.begin()
        self.plug(False)
        began = self.clock.now()
        with assert_raises(LinkError):
            while self.clock.now() < began + SILENCE:
                self.robot.send(home)
                self.wait(SETPOINT_PERIOD)
                self.robot.replies()
        self.stays_failed()
        assert_raises(LinkError, self.robot.send, home)

    def stays_failed(self) -> None:
        """Put the cable of a failed link back; the driver must not use the link again."""
        self.plug(True)
        with suppress(LinkError):
            self.clock.wait_until(self.clock.now() + 0.5)
        for call in (self.robot.measured, self.robot.start):
            assert_raises(LinkError, call)


_assert_near = partial(assert_allclose, rtol=0.0, equal_nan=False)


def _measured_on_the_way(reply: Reply, track: list[tuple[float, Array]]) -> None:
    """Fail a test unless the arm was at the joints of a reply when it was measured."""
    recent = [q for time, q in track if reply.sent - MAX_AGE <= time <= reply.received]
    if recent:
        nearest = np.clip(np.array(reply.q), np.min(recent, axis=0), np.max(recent, axis=0))
        on_the_way = f"on the way; older than {1e3 * MAX_AGE:g} ms, or commanded, not measured?"
        _same_joints(reply.q, nearest, STILL, on_the_way)


def _same_joints(q: Any, expected: Any, tolerance: float = CLOSE, where: str = "") -> None:
    """Fail a test unless joints are as expected [rad]; name the joint and a likely mistake."""
    q, expected = np.asarray(q), np.asarray(expected)
    error = np.abs(q - expected)
    mistakes = {
        "in degrees": np.radians(q) - expected,
        "of the wrong sign": np.abs(q) - np.abs(expected),
        "in another order": np.sort(q) - np.sort(expected),
    }
    likely = [name for name, left in mistakes.items() if np.abs(left).max() <= 5.0 * CLOSE]
    joint = int(np.argmax(error))
    assert error.max() <= tolerance, (
        f"joint {joint + 1} is at {q[joint]:.4g} rad, expected {expected[joint]:.4g} rad "
        f"{where}; maybe {' or '.join(likely) or 'another joint'}"
    )


def _path(home: Array) -> Array:
    """Return a smooth motion of the first joint, and a second of rest at its end [rad]."""
    times = np.arange(SETPOINT_PERIOD, 1.5, SETPOINT_PERIOD)
    path = np.tile(home, (len(times), 1))
    path[:, 0] += 0.025 * (1.0 - np.cos(2.0 * pi * np.minimum(times, 0.5)))
    return path


class WorldConformance:
    """Tests of a simulated world: of a `Simulation` and its closed loops."""

    ENCODER = True
    """Whether the controller observes through an encoder; otherwise it knows the state."""

    def make(self) -> tuple[Simulation, Setup]:
        """Return a simulation, and pendulum, arm and controller of its trials."""
        raise NotImplementedError

    def released(self) -> tuple[ClosedLoop, Simulation, Setup]:
        """Return a closed loop after the release of trial 3."""
        simulation, setup = self.make()
        loop = simulation.loop()
        loop.reset(simulation.draw(1, first=3).trial(0))
        return loop, simulation, setup

    def test_conditions_depend_on_the_number_of_a_trial_alone(self) -> None:
        simulation, _ = self.make()
        assert simulation.draw(5).trial(3) == simulation.draw(1, first=3).trial(0)

    def test_a_release_leaves_the_arm_at_rest_at_home_and_the_pendulum_as_drawn(self) -> None:
        loop, simulation, setup = self.released()
        start, state = simulation.draw(1, first=3).start[0], loop.state()
        _assert_near(state[:3], start[:3], atol=2e-3)
        _assert_near(state[3], start[3], atol=0.05)
        _assert_near(loop.joints(), setup.arm.home, atol=2e-3)
        assert loop.now == 0.0

    def test_the_controller_observes_what_is_true(self) -> None:
        loop, _, setup = self.released()
        for _ in range(5):
            loop.step(0.0)
        measured = loop.measurement()
        _assert_near(predicted(loop), loop.state(), atol=0.2)
        assert (measured is not None) == self.ENCODER
        if measured is not None:
            _assert_near(measured.q, np.array(loop.joints())[list(setup.arm.free)], atol=2e-3)
            shown = pi - measured.counts * loop.params.resolution - (loop.zero or 0.0)
            _assert_near(shown, loop.state()[2], atol=0.02)
            assert measured.counted_at <= loop.now + 1e-3, "a count comes from the future"
            assert measured.measured_at <= loop.now, "a measurement comes from the future"

    def test_the_flange_accelerates_as_commanded_and_the_pendulum_falls_the_other_way(self) -> None:
        loop, simulation, _ = self.released()
        states: list[Any] = []
        ticks, push = 10, 1.0  # [m/s^2]
        for u in (0.0, push):
            loop.reset(simulation.draw(1, first=3).trial(0))
            for _ in range(ticks):
                loop.step(u)
            states.append(loop.state())
        alone, pushed = states
        speed = push * ticks * loop.params.h  # that of an arm without a delay
        assert abs(alone[0]) < 1e-3
        assert 0.2 * speed < pushed[1] < 1.05 * speed
        assert pushed[2] < alone[2], "the pendulum does not fall against the acceleration"

    def test_a_pendulum_that_nobody_balances_falls_and_the_cause_says_so(self) -> None:
        loop, _, _ = self.released()
        cause, steps = TRUNCATED, 0
        while cause == TRUNCATED and steps < 200:
            cause, steps = loop.step(0.0), steps + 1
        assert cause >= ANGLE
        assert 10 < steps < 200

    def test_the_same_trial_has_the_same_bits(self) -> None:
        loop, simulation, _ = self.released()
        runs: list[bytes] = []
        for _ in range(2):
            loop.reset(simulation.draw(1, first=3).trial(0))
            states = [loop.state()]
            for tick in range(10):
                loop.step(0.5 if tick % 2 else -0.5)
                states.append(loop.state())
            runs.append(np.array(states).tobytes())
        assert runs[0] == runs[1]
