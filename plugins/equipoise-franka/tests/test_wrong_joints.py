"""Joints of an FR3 that are measured wrongly, in any phase: the true arm stays on its path."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.outcomes import Phase
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.plugins import Session
from equipoise_franka.robot import FrankaRobot
from tests.conftest import tiers
from tests.rig.test_run_controller import POLICY, REQUEST, Course, H, balancing

from .controller import Controller

pytestmark = pytest.mark.compiled_only

SETTINGS = RigSettings(arm="fr3")
ARM = SETTINGS.described_arm
FOR_FR3 = POLICY.model_copy(update={"arm": ARM})
FR3 = replace(REQUEST, policy=FOR_FR3, settings=SETTINGS, robot="franka://fr3")
MOVED = 0.002
"""Maximum distance of the true arm from its setpoints after a stop [rad]."""
LAG = 0.05
"""Time by which the arm may follow its setpoints [s]."""


class Rig(Course):
    """A course whose setpoints go through the guard to an FR3, and whose replies are its own."""

    def __init__(self, identify=None, away=0.0):
        self.clock = VirtualClock()
        q = np.add(ARM.home, away * np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0]))
        self.arm, self.true = Controller(q, self.clock), []
        self.clock.attach(lambda now: self.true.append((now, self.arm.q)))
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, "pylibfranka", self.arm)
            self.stream = FrankaRobot("fr3", Session(self.clock, self.clock))
            self.stream.connect()
        super().__init__(q, identify, FR3)
        self.robot = GuardedRobot(self.stream, self.guard.limits, 0.005)
        self.robot.start()

    def replies(self):
        return self.stream.replies()

    def tick(self, **inputs):
        self.stream.wait_until(H * (self.tick_number + 1))
        output = super().tick(**inputs)
        for place, setpoint in enumerate(output.setpoints):
            self.stream.wait_until(self.now + 0.5 * H * place)
            self.robot.send(setpoint, to_rest=output.to_rest)
        return output

    def stopped(self, after=4.0):
        """Go on until it rests after a stop, by a key at the latest; return its problems."""
        end = self.now + after
        while self.pilot.end is None:
            number, began = len(self.sent) - 1, self.clock.now()
            self.tick(**({"lines": ["stop"]} if self.now > end else {}))
        self.stopped_at = self.now
        while not self.tick().done:
            assert self.now < end + 5.0
        self.stream.stop()
        self.clock.wait_until(self.clock.now() + 0.5)
        self.arm.close()
        late = [q for time, q in self.sent if time > self.sent[number][0] - LAG]
        true = np.array([q for time, q in self.true if time >= began])
        left = np.maximum(np.min(late, axis=0) - true, true - np.max(late, axis=0)).max()
        away = np.abs(np.subtract([q for _, q in self.sent[number:]], self.sent[number][1]))
        steps = np.abs(np.diff([q for _, q in self.sent[number:]], axis=0)).max(axis=1)
        ramp = 2 + int(np.argmax(np.diff(steps) >= 0.0))  # up to rest it slows down
        return float(left), float((away.max(axis=0) - away[:ramp].max(axis=0)).max())


PHASES = {
    "homing": (lambda: Rig(away=0.1), 20),
    "self-test": (lambda: Rig().until(Phase.SELF_TEST), 30),
    "excitation": (lambda: Rig(lambda *_: None).until(Phase.EXCITING), 50),
    "balancing": (lambda: balancing(Rig), 10),
}
"""Rigs at the begin of each phase in which the arm moves, and ticks until it moves fast."""


def phase(name):
    """Return a rig in a phase in which the arm moves."""
    make, ticks = PHASES[name]
    rig = make()
    rig.ticks(ticks)
    return rig


def report(rig, error, joint=0):
    """Measure a joint of a rig from now on with an error [rad] of the time since [s] and angle."""
    began = rig.clock.now()

    def wrong(state):
        off = error(rig.clock.now() - began, rig.arm.q[joint])
        state.q = tuple(rig.arm.q + off * np.eye(7)[joint])
        return state

    rig.arm.report = wrong


def replaced(**values):
    """Return what reports a state with other values."""

    def report(state):
        vars(state).update(values)
        return state

    return report


@pytest.mark.parametrize(
    ("faulty", "words"),
    [
        (replaced(dq_d=(np.nan,) * 7), r"reports \[nan, .* finite .*; restart the controller"),
        (replaced(time=SimpleNamespace(to_sec=lambda: 1.0)), ", 0 s after .* later time; restart"),
    ],
)
def test_what_the_controller_reports_ends_the_link_with_its_cause_and_remedy(faulty, words):
    rig = phase("homing")
    rig.arm.report = faulty
    with pytest.raises(LinkError, match=words):
        rig.ticks(2)
    rig.arm.close()


@pytest.mark.parametrize("wrong", [0.1, -9.0, np.nan])
@pytest.mark.parametrize("lies", ["measured", "request"])
def test_a_start_that_the_first_request_contradicts_answers_nothing(monkeypatch, lies, wrong):
    clock = VirtualClock()
    arm = Controller(ARM.home, clock)
    monkeypatch.setitem(sys.modules, "pylibfranka", arm)
    robot = FrankaRobot("fr3", Session(clock, clock))
    robot.connect()
    faulty, correct = replaced(q=tuple(np.add(ARM.home, wrong))), arm.report
    arm.report = faulty if lies == "measured" else correct
    robot.start()
    arm.report = faulty if lies == "request" else correct
    arm.writeOnce = lambda _: pytest.fail("it was answered")
    with pytest.raises(LinkError, match="from its posture at the start"):
        robot.wait_until(clock.now() + 0.02)
    with pytest.raises(LinkError, match="from its posture at the start"):
        robot.send(ARM.home)
    arm.close()


def drawn(random, rig):
    """Measure a joint of a rig wrongly from now on; return how."""
    joint = int(random.integers(7))
    sign, frozen = random.choice((-1.0, 1.0)), rig.arm.q[joint]
    step, rate = sign * 10.0 ** random.uniform(-2.0, 0.5), sign * 10.0 ** random.uniform(-1.0, 1.2)
    errors = {
        "off": lambda time, q: step,
        "runs off": lambda time, q: np.clip(rate * time, -1.5, 1.5),
        "swings": lambda time, q: min(abs(step), 0.3) * np.sin(rate * time),
        "frozen": lambda time, q: frozen - q,
    }
    name = str(random.choice(list(errors)))
    report(rig, errors[name], joint)
    return f"joint {joint + 1} {name}, {step:.3f} rad, {rate:.3f} rad/s"


@pytest.mark.parametrize("seed", tiers(range(200), range(len(PHASES))))
def test_wrong_joints_leave_the_targets_in_the_reach_of_the_ramp_and_the_arm_on_its_path(seed):
    random = np.random.default_rng([seed, 44])
    rig = phase(list(PHASES)[seed % len(PHASES)])
    how = drawn(random, rig)
    left, beyond = rig.stopped()
    assert beyond < 1e-5, how
    assert left < MOVED, how
