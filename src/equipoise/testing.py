"""Conformance suites of robots and simulated worlds, for tests of external ones.

A driver's test implements `make`; pytest collects the tests by name::

    from equipoise.testing import RobotConformance


    class TestMyRobot(RobotConformance):
        def make(self):
            return my_robot, its_clock

The tests of this package use the same classes. They go through the interfaces alone, so that they
hold for hardware as well: the first joint moves by 0.02 rad.
"""

from collections.abc import Callable, Iterable
from math import nan, pi
from typing import Any, Final

import numpy as np

from equipoise.control.grid import ANGLE, TRUNCATED
from equipoise.control.minimum_jerk import Path
from equipoise.errors import EquipoiseError, InputError, LinkError
from equipoise.rig.interfaces import SETPOINT_PERIOD, Array, Clock, Reply, Robot
from equipoise.worlds import ClosedLoop, Setup, Simulation, predicted

CLOSE: Final = 2e-3
"""Error of position that a servo with a soft dead band leaves after a second [rad]."""


def expect_error(kind: type[Exception], call: Callable[..., Any], *arguments: Any) -> None:
    """Fail a test unless a call raises an error of a kind.

    Raises:
        AssertionError: It returns.
    """
    try:
        call(*arguments)
    except kind:
        return
    raise AssertionError(f"{call} with {arguments} returned, expected {kind.__name__}")


def _near(q: Any, expected: Any, tolerance: float = CLOSE) -> None:
    error = float(np.abs(np.subtract(q, expected)).max())
    assert error <= tolerance, f"{error:.2g} off, expected at most {tolerance:g}"


class RobotConformance:
    """Tests of a `Robot`; a robot that sets the pace is tested as a `PacedStream`."""

    robot: Robot
    """The robot of a test."""
    clock: Clock
    """Clock of its rig."""

    def make(self) -> tuple[Robot, Clock]:
        """Return a new robot at rest, not connected, and the clock of its rig."""
        raise NotImplementedError

    def begin(self) -> Array:
        """Connect, start the servo, and return the measured joints [rad], shape (joints,)."""
        self.robot, self.clock = self.make()
        self.robot.connect()
        home = self.robot.measured()
        self.robot.start()
        return home

    def teardown_method(self) -> None:
        """Close the robot, whatever failed."""
        if hasattr(self, "robot"):
            self.robot.close()

    def wait(self, seconds: float) -> None:
        """Wait [s]."""
        self.clock.wait_until(self.clock.now() + seconds)

    def stream(self, setpoints: Iterable[Any]) -> tuple[list[float], list[Reply]]:
        """Send setpoints [rad], one each period; return their times [s] and their replies."""
        sent, replies = list[float](), list[Reply]()
        for q in setpoints:
            sent.append(self.clock.now())
            self.robot.send(q)
            self.wait(SETPOINT_PERIOD)
            replies += self.robot.replies()
        for _ in range(100):
            if len(replies) < len(sent):
                self.wait(0.001)
                replies += self.robot.replies()
        assert len(replies) == len(sent), "expected one reply to each setpoint"
        return sent, replies

    def follow(self, setpoints: Iterable[Any]) -> Array:
        """Send setpoints [rad]; return the measured joints of their replies [rad]."""
        _, replies = self.stream(setpoints)
        return np.array([reply.q for reply in replies if reply.q is not None])

    def test_it_is_a_robot_and_its_joints_are_measured_before_the_servo_runs(self) -> None:
        self.robot, self.clock = self.make()
        robot = self.robot
        assert isinstance(robot, Robot)
        assert isinstance(self.clock, Clock)
        robot.close()  # without connect it does nothing
        robot.connect()
        q = robot.measured()
        assert q.shape == (robot.joints,)
        self.wait(0.5)
        _near(robot.measured(), q, 1e-4)
        expect_error(LinkError, robot.send, q)  # no servo runs
        robot.stop()  # without a servo it does nothing
        _near(robot.measured(), q, 1e-4)

    def test_setpoints_are_followed_without_a_way_back(self) -> None:
        home = self.begin()
        _near(self.follow([home] * 40), home)
        path = _path(home)
        q = self.follow(path)
        _near(q[-1], path[-1])
        assert np.diff(q[:, 0]).min() > -5e-4, "the joint went back on its way"

    def test_each_setpoint_has_its_reply_in_order_with_its_times(self) -> None:
        home = self.begin()
        assert self.robot.replies() == []
        sent, replies = self.stream(_path(home))
        self.wait(0.5)
        assert self.robot.replies() == [], "a setpoint has two replies"
        assert [reply.sent for reply in replies] == sent
        received = [reply.received for reply in replies]
        assert received == sorted(received)
        assert received[-1] <= self.clock.now()
        assert any(reply.torque for reply in replies), "torques never came"
        for reply in replies:
            given = [part for part in (reply.q, reply.torque) if part is not None]
            assert given, "a reply has neither joints nor torques"
            assert np.isfinite(given).all()
            assert {len(part) for part in given} == {self.robot.joints}
            assert reply.sent <= reply.received

    def test_stop_leaves_the_arm_where_it_is_and_another_start_holds_it_there(self) -> None:
        there = self.follow(_path(self.begin()))[-1]
        self.robot.stop()
        _near(self.robot.measured(), there)
        self.wait(1.0)
        _near(self.robot.measured(), there)
        self.robot.start()
        self.wait(0.5)
        _near(self.follow([there] * 2)[-1], there)

    def test_a_wrong_setpoint_is_refused_and_not_sent(self) -> None:
        home = self.begin()
        robot, n = self.robot, self.robot.joints
        for i in range(n):
            expect_error(InputError, robot.send, np.where(np.arange(n) == i, nan, 0.0))
        for count in (0, n - 1, n + 1):
            expect_error(InputError, robot.send, [0.0] * count)
        self.wait(0.1)
        assert robot.replies() == [], "a refused setpoint has a reply"
        _near(self.follow([home] * 10)[-1], home)

    def test_close_may_be_called_again_and_nothing_works_after_it(self) -> None:
        home = self.begin()
        self.robot.close()
        self.robot.close()
        expect_error(LinkError, self.robot.send, home)
        for call in (self.robot.measured, self.robot.start):
            expect_error(EquipoiseError, call)


def _path(home: Array) -> Array:
    """Return a smooth motion of the first joint, and a second of rest at its end [rad]."""
    times, move = np.arange(SETPOINT_PERIOD, 1.5, SETPOINT_PERIOD), Path((0.0,), (0.02,), 0.5)
    path = np.tile(home, (len(times), 1))
    path[:, 0] += [move.at(time).q[0] for time in times.tolist()]
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
        _near(state[:3], start[:3], 2e-3)
        _near(state[3], start[3], 0.05)
        _near(loop.joints(), setup.arm.home, 2e-3)
        assert loop.now == 0.0

    def test_the_controller_observes_what_is_true(self) -> None:
        loop, _, setup = self.released()
        for _ in range(5):
            loop.step(0.0)
        measured = loop.measurement()
        _near(predicted(loop), loop.state(), 0.2)
        assert (measured is not None) == self.ENCODER
        if measured is not None:
            _near(measured.q, np.array(loop.joints())[list(setup.arm.free)], 2e-3)
            shown = pi - measured.counts * loop.params.resolution - (loop.zero or 0.0)
            _near(shown, loop.state()[2], 0.02)
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
