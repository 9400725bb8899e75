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


class RobotSession:
    """Connected robot with a running servo, and its setpoints and replies; closed after use."""

    def __init__(self, robot: Robot, clock: Clock) -> None:
        """Create a session with an unconnected robot."""
        self.robot, self.clock = robot, clock
        self.sent: list[float] = []
        self.replies: list[Reply] = []

    def __enter__(self) -> "RobotSession":
        """Connect, and start the servo."""
        self.robot.connect()
        self.home = self.robot.measured()
        self.robot.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the robot."""
        self.robot.close()

    def wait(self, seconds: float) -> None:
        """Wait [s]."""
        self.clock.wait_until(self.clock.now() + seconds)

    def stream(self, setpoints: Iterable[Any]) -> None:
        """Send setpoints [rad], one each period, and wait until each has its reply."""
        for q in setpoints:
            self.sent.append(self.clock.now())
            self.robot.send(q)
            self.wait(SETPOINT_PERIOD)
            self.replies += self.robot.replies()
        for _ in range(100):
            if len(self.replies) < len(self.sent):
                self.wait(0.001)
                self.replies += self.robot.replies()
        assert len(self.replies) == len(self.sent), "expected one reply to each setpoint"

    def path(self) -> Array:
        """Return a smooth motion of the first joint, and a second of rest at its end [rad]."""
        times, move = np.arange(SETPOINT_PERIOD, 1.5, SETPOINT_PERIOD), Path((0.0,), (0.02,), 0.5)
        path = np.tile(self.home, (len(times), 1))
        path[:, 0] += [move.at(time).q[0] for time in times.tolist()]
        return path

    def joints(self) -> Array:
        """Return the measured joints of all replies that have them [rad], shape (n, joints)."""
        return np.array([reply.q for reply in self.replies if reply.q is not None])


class RobotConformance:
    """Tests of a `Robot`; a robot that sets the pace is tested as a `PacedStream`."""

    def make(self) -> tuple[Robot, Clock]:
        """Return a new robot at rest, not connected, and the clock of its rig."""
        raise NotImplementedError

    def test_it_is_a_robot_with_a_clock(self) -> None:
        robot, clock = self.make()
        assert isinstance(robot, Robot)
        assert isinstance(clock, Clock)
        robot.close()  # without connect it does nothing

    def test_joints_are_measured_before_the_servo_runs(self) -> None:
        robot, clock = self.make()
        robot.connect()
        q = robot.measured()
        assert q.shape == (robot.joints,)
        clock.wait_until(clock.now() + 0.5)
        _near(robot.measured(), q, 1e-4)
        expect_error(LinkError, robot.send, q)  # no servo runs
        robot.stop()  # without a servo it does nothing
        _near(robot.measured(), q, 1e-4)
        robot.close()

    def test_setpoints_are_followed_without_a_way_back(self) -> None:
        with RobotSession(*self.make()) as session:
            session.stream([session.home] * 40)
            _near(session.joints(), session.home)
            session.stream(session.path())
            q = session.joints()
            _near(q[-1], session.path()[-1])
            assert np.diff(q[40:, 0]).min() > -5e-4, "the joint went back on its way"

    def test_each_setpoint_has_its_reply_in_order_with_its_times(self) -> None:
        with RobotSession(*self.make()) as session:
            assert session.robot.replies() == []
            session.stream(session.path())
            session.wait(0.5)
            assert session.robot.replies() == [], "a setpoint has two replies"
            replies = session.replies
            assert [reply.sent for reply in replies] == session.sent
            received = [reply.received for reply in replies]
            assert received == sorted(received)
            assert received[-1] <= session.clock.now()
            assert any(reply.torque for reply in replies), "torques never came"
            for reply in replies:
                given = [part for part in (reply.q, reply.torque) if part is not None]
                assert given, "a reply has neither joints nor torques"
                assert np.isfinite(given).all()
                assert {len(part) for part in given} == {session.robot.joints}
                assert reply.sent <= reply.received

    def test_stop_leaves_the_arm_where_it_is_and_another_start_holds_it_there(self) -> None:
        with RobotSession(*self.make()) as session:
            robot = session.robot
            session.stream(session.path())
            there = session.joints()[-1]
            robot.stop()
            _near(robot.measured(), there)
            session.wait(1.0)
            _near(robot.measured(), there)
            robot.start()
            session.wait(0.5)
            session.stream([there] * 2)
            _near(session.joints()[-1], there)

    def test_a_wrong_setpoint_is_refused_and_not_sent(self) -> None:
        with RobotSession(*self.make()) as session:
            robot, n = session.robot, session.robot.joints
            for i in range(n):
                expect_error(InputError, robot.send, np.where(np.arange(n) == i, nan, 0.0))
            for count in (0, n - 1, n + 1):
                expect_error(InputError, robot.send, [0.0] * count)
            session.wait(0.1)
            assert robot.replies() == [], "a refused setpoint has a reply"
            session.stream([session.home] * 10)
            _near(session.joints()[-1], session.home)

    def test_close_may_be_called_again_and_nothing_works_after_it(self) -> None:
        with RobotSession(*self.make()) as session:
            robot = session.robot
            robot.close()
            robot.close()
            expect_error(LinkError, robot.send, session.home)
            for call in (robot.measured, robot.start):
                expect_error(EquipoiseError, call)


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
