"""The driver on the vendor's library, against the controller of `franky-sim` in lockstep."""

import numpy as np
import pytest

pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")

from equipoise.control.policy import shipped_policy
from equipoise.errors import LinkError
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.outcomes import Outcome
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.paced import PacedStream
from equipoise.rig.plugins import Bodies
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.robots.franka import robot as driver
from equipoise.robots.franka.arm import fr3
from equipoise.robots.franka.lockstep import Lockstep
from equipoise.robots.franka.robot import FrankaRobot
from equipoise.testing import RobotConformance, RobotUnderTest

pytestmark = pytest.mark.compiled_only


class Bench:
    """An arm at rest at home, and its driver."""

    def __init__(self):
        arm, settings = fr3(), read_world("twin:nominal").settings
        pendulum = pendulum_on(shipped_pendulum(), settings)
        self.rig = Lockstep(Bodies(arm, pendulum, settings, arm.home_free, 0.0, 0))
        clock = VirtualClock()
        clock.attach(self.rig.advance)
        clock.wait_until(0.5)
        self.robot = PacedStream(FrankaRobot(self.rig.host, clock), clock)


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.robot.close()
    bench.rig.close()


class TestFranka(RobotConformance):
    def make(self):
        self.bench = Bench()
        rig, robot = self.bench.rig, self.bench.robot
        return RobotUnderTest(robot, robot, rig.plug, lambda: rig.q)

    def teardown_method(self):
        super().teardown_method()
        self.bench.rig.close()


def at(moment, act):
    """Return a path at rest, during which an act happens at a time [s]."""

    def offset(time):
        if abs(time - moment) < 0.001:
            act()
        return 0.0

    return offset


def stream(robot, offset, seconds=0.5):
    """Stream joint 1 along a path [rad] of the time [s]; return the error's message."""
    home = robot.measured()
    robot.start()
    for k in range(round(seconds / 0.005)):
        robot.send(home + np.eye(7)[0] * offset(0.005 * k))
        robot.wait_until(robot.now() + 0.005)
        robot.replies()


def test_a_jump_of_the_path_is_smoothed_and_without_the_limits_it_is_rejected(bench, monkeypatch):
    bench.robot.connect()

    def jump(time):
        return 0.01 * (time > 0.1)

    stream(bench.robot, jump)
    bench.robot.stop()
    monkeypatch.setattr(driver, "limited", lambda v, *_: v)
    with pytest.raises(LinkError, match="discontinuity"):
        stream(bench.robot, jump)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda rig: rig.stop("joint_reflex"), "look for a contact"),
        (lambda rig: rig.stop(), "user stop|preempted"),
    ],
    ids=["reflex", "user stop"],
)
def test_a_stop_of_the_controller_ends_the_stream_and_names_its_remedy(bench, fault, words):
    robot = bench.robot
    robot.connect()
    with pytest.raises(LinkError, match=words):
        stream(robot, at(0.2, lambda: fault(bench.rig)))


def test_no_motion_begins_until_the_operator_has_cleared_an_error(bench):
    bench.rig.stop("joint_reflex")
    with pytest.raises(LinkError, match="stopped by an error; inspect the arm"):
        bench.robot.connect()


def test_a_motion_without_commands_is_stopped(bench):
    robot = bench.robot
    robot.connect()
    with pytest.raises(LinkError, match="packets were late or lost"):
        stream(robot, at(0.2, lambda: bench.rig.advance(robot.now() + 0.03)))


def test_a_policy_balances_a_pendulum_on_an_fr3():
    settings = RigSettings(arm="fr3")
    policy = shipped_policy().model_copy(update={"arm": settings.described_arm})
    request = RunRequest(policy, policy.actuator, settings, "franka://twin:fr3", None, 5.0)
    end = run_virtually(request, None)
    assert end.outcome is Outcome.LASTED, end.reason
