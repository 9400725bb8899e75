"""The driver on the vendor's library, against the controller of `franky-sim` in lockstep."""

import re

import numpy as np
import pytest

pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")

from equipoise.control.policy import shipped_policy
from equipoise.errors import LinkError
from equipoise.log.run_log import RunLog
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.outcomes import Outcome, Phase
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import Load, RigSettings
from equipoise.rig.connection import connect
from equipoise.rig.explanation import explain
from equipoise.rig.plugins import Session
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.rig.run_controller import RunController
from equipoise.rig.simulated_rig import Bodies
from equipoise.testing import MISREAD, RobotConformance, RobotUnderTest
from equipoise_franka import robot as driver
from equipoise_franka.arm import fr3
from equipoise_franka.lockstep import Lockstep
from equipoise_franka.robot import FrankaRobot
from tests.conftest import tiers
from tests.faults.test_over_the_wires import balances

pytestmark = pytest.mark.compiled_only


class Rig:
    """An arm near home on a controller in a process of its own, which serves many drivers."""

    def __init__(self):
        arm, settings = fr3(), read_world("twin:nominal").settings
        pendulum = pendulum_on(shipped_pendulum(), settings)
        self.arm = Lockstep(Bodies(arm, pendulum, settings, arm.home_free, 0.0, 0))
        self.clock = VirtualClock()
        self.clock.attach(self.arm.advance)
        self.clock.wait_until(0.5)

    def driver(self, load=None):
        """Return a driver of the controller after all faults have been cleared."""
        self.arm.plug(True)
        self.arm.set_free()
        self.arm.mismeasure(np.zeros(7))
        self.clock.wait_until(self.clock.now() + 0.5)
        return FrankaRobot(self.arm.host, Session(self.clock, self.clock, load=load))


@pytest.fixture(scope="module")
def rig():
    rig = Rig()
    yield rig
    rig.arm.close()


@pytest.fixture
def robot(rig):
    robot = rig.driver()
    yield robot
    robot.close()


class TestFranka(RobotConformance):
    @pytest.fixture(autouse=True)
    def use(self, rig):
        self.rig = rig

    def make(self):
        arm, robot = self.rig.arm, self.rig.driver()

        def misread(numbers):  # all from now on: the controller has a process of its own
            arm.mismeasure(MISREAD * np.eye(7)[0])

        return RobotUnderTest(robot, robot, arm.plug, lambda: arm.q, misread)


def stream(robot, offset, seconds=0.5):
    """Stream joint 1 along a path [rad] of the time [s]; return the error's message."""
    home = robot.measured()
    robot.start()
    for k in range(round(seconds / 0.005)):
        robot.send(home + np.eye(7)[0] * offset(0.005 * k))
        robot.wait_until(robot.now() + 0.005)
        robot.replies()


def test_a_jump_of_the_path_is_smoothed_and_without_the_limits_it_is_rejected(robot, monkeypatch):
    robot.connect()

    def jump(time):
        return 0.01 * (time > 0.1)

    stream(robot, jump)
    robot.stop()
    monkeypatch.setattr(driver, "limited", lambda v, *_: v)
    with pytest.raises(LinkError, match="discontinuity"):
        stream(robot, jump)


FAULTS = {
    "20 lost packets": (lambda rig, now: rig.advance(now + 0.03), "packets were late or lost"),
    "reflex": (lambda rig, now: rig.stop("joint_reflex"), "look for a contact"),
    "user stop": (lambda rig, now: rig.stop(), "preempted.*; a user stop is active; release it"),
    "a controller that dies": (lambda rig, now: rig.reset_state(), "requested nothing"),
    "a cable that is pulled": (lambda rig, now: rig.plug(False), "requested nothing"),
    "joints that stand still": (lambda rig, now: rig.freeze(times=True), "the same joints"),
    "a time that stalls": (lambda rig, now: rig.freeze(times=False), "UDP receive: Timeout"),
}
"""For each fault its act on the rig, and words of the error."""


@pytest.mark.parametrize(("fault", "words"), FAULTS.values(), ids=FAULTS)
def test_a_fault_ends_the_stream_and_names_its_remedy(rig, robot, fault, words):
    robot.connect()

    def offset(time):
        if abs(time - 0.2) < 0.001:
            fault(rig.arm, robot.now())
        return 0.02 * (1.0 - np.cos(10.0 * time))

    with pytest.raises(LinkError, match=words):
        stream(robot, offset)


@pytest.mark.parametrize("name", tiers(FAULTS, (), ("reflex", "joints that stand still")))
def test_a_fault_ends_a_balance_with_the_arm_at_rest_and_its_cause_in_the_log(
    tmp_path, monkeypatch, name
):
    (fault, words), request = FAULTS[name], requested()
    rig = connect(request)
    before = []

    class FaultyController(RunController):
        def tick(self, now, inputs):
            if self.run.balanced == 100 and self.run.phase is Phase.BALANCING:
                before.append(rig.bench.q)
                fault(rig.bench, now)
            return super().tick(now, inputs)

    monkeypatch.setattr("equipoise.rig.run.RunController", FaultyController)
    log = tmp_path / "run.mcap"
    end = run_virtually(request, log, rig=rig)
    assert end.outcome is Outcome.LINK_LOST
    assert re.search(words, end.reason)
    assert 1.0 <= end.survival < 1.2
    cause = explain(RunLog.load(log))[0]
    assert cause.cause is Outcome.LINK_LOST
    assert re.search(words, cause.evidence)
    time = rig.clock.now()
    for seconds in (0.1, 0.2):
        rig.bench.advance(time + seconds)
        assert np.abs(rig.bench.q - before[-1]).max() < (0.05 if len(before) == 1 else 1e-3)
        before.append(rig.bench.q)


@pytest.mark.parametrize(
    ("stop", "words"),
    [
        (lambda rig: rig.stop("joint_reflex"), "stopped by an error; inspect the arm.*contact"),
        (lambda rig: rig.stop("self_collision_avoidance_violation"), "choose another home"),
        (lambda rig: rig.stop(), "release it"),
        (lambda rig: rig.lock(), "joints are locked"),
    ],
    ids=["reflex", "self-collision", "user stop", "brakes"],
)
def test_nothing_is_measured_before_the_operator_has_cleared_a_stop(rig, robot, stop, words):
    stop(rig.arm)
    with pytest.raises(LinkError, match=words):
        robot.connect()


def test_a_load_is_no_external_torque():
    rig = Rig()  # whose pendulum hangs still
    robot = rig.driver(load=Load(0.25, (0.065, 0.0, 0.0)))
    without = rig.arm.external_torque()
    robot.connect()
    robot.start()
    rig.arm.advance(rig.clock.now() + 0.5)
    assert np.abs(rig.arm.external_torque()).max() < 0.2 < 0.2 * np.abs(without).max()
    robot.close()
    rig.arm.close()


def requested(duration=5.0, seed=0):
    """Return the request for a balance [s] with the shipped policy."""
    settings = RigSettings(arm="fr3")
    policy = shipped_policy().model_copy(update={"arm": settings.described_arm})
    task = policy, policy.actuator, settings
    return RunRequest(*task, "franka://twin:fr3", None, duration, seed=seed)


def test_a_policy_balances_a_pendulum_on_an_fr3():
    end = run_virtually(requested(), None)
    assert end.outcome is Outcome.SURVIVED, end.reason


@pytest.mark.slow
def test_a_policy_balances_over_the_wires_of_the_emulated_rig(tmp_path):
    balances(tmp_path, "fr3", "--robot", "franka")
