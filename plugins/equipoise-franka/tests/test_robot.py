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
from equipoise_franka.paced import PacedStream
from equipoise_franka.robot import FrankaRobot
from tests.faults.test_over_the_wires import balances

pytestmark = pytest.mark.compiled_only


class Bench:
    """An arm at rest at home, and its driver."""

    def __init__(self, load=None):
        arm, settings = fr3(), read_world("twin:nominal").settings
        pendulum = pendulum_on(shipped_pendulum(), settings)
        self.rig = Lockstep(Bodies(arm, pendulum, settings, arm.home_free, 0.0, 0))
        clock = VirtualClock()
        clock.attach(self.rig.advance)
        clock.wait_until(0.5)
        session = Session(clock, clock, load=load)
        self.robot = PacedStream(FrankaRobot(self.rig.host, session), clock)


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

        def misread(numbers):  # all from now on: the controller has a process of its own
            rig.mismeasure(MISREAD * np.eye(7)[0])

        return RobotUnderTest(robot, robot, rig.plug, lambda: rig.q, misread)

    def teardown_method(self):
        super().teardown_method()
        self.bench.rig.close()


def at(moment, act):
    """Return a slow motion [rad], during which an act happens at a time [s]."""

    def offset(time):
        if abs(time - moment) < 0.001:
            act()
        return 0.02 * (1.0 - np.cos(10.0 * time))

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
def test_a_fault_ends_the_stream_and_names_its_remedy(bench, fault, words):
    robot = bench.robot
    robot.connect()
    with pytest.raises(LinkError, match=words):
        stream(robot, at(0.2, lambda: fault(bench.rig, robot.now())))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        pytest.param(
            *case,
            marks=pytest.mark.full
            if name in ("reflex", "joints that stand still")
            else pytest.mark.slow,
            id=name,
        )
        for name, case in FAULTS.items()
    ],
)
def test_a_fault_ends_a_balance_with_the_arm_at_rest_and_its_cause_in_the_log(
    tmp_path, monkeypatch, fault, words
):
    request = requested()
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
def test_nothing_is_measured_before_the_operator_has_cleared_a_stop(bench, stop, words):
    stop(bench.rig)
    with pytest.raises(LinkError, match=words):
        bench.robot.connect()


def test_a_load_is_no_external_torque():
    bench = Bench(load=Load(0.25, (0.065, 0.0, 0.0)))
    without = bench.rig.external_torque()
    bench.robot.connect()
    bench.robot.start()
    bench.rig.advance(1.0)
    assert np.abs(bench.rig.external_torque()).max() < 0.2 < 0.2 * np.abs(without).max()
    bench.robot.close()
    bench.rig.close()


def requested():
    """Return the request for a balance of 5 s with the shipped policy."""
    settings = RigSettings(arm="fr3")
    policy = shipped_policy().model_copy(update={"arm": settings.described_arm})
    return RunRequest(policy, policy.actuator, settings, "franka://twin:fr3", None, 5.0)


def test_a_policy_balances_a_pendulum_on_an_fr3():
    end = run_virtually(requested(), None)
    assert end.outcome is Outcome.SURVIVED, end.reason


@pytest.mark.slow
def test_a_policy_balances_over_the_wires_of_the_emulated_rig(tmp_path):
    balances(tmp_path, "fr3", "--robot", "franka")
