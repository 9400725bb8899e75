"""The rules as kernels ask them: the same verdicts as in Python, and when they are asked."""

from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equipoise.arm.iiwa import iiwa
from equipoise.arrays import fields, new_records
from equipoise.control.control_step import ControllerState, make_controller_params
from equipoise.control.policy import shipped_policy
from equipoise.jit import kernel
from equipoise.model.actuator import IDEAL_ACTUATOR
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import World, read_world
from equipoise.outcomes import SAFETY_RULES, Outcome
from equipoise.safety import rules
from equipoise.safety.rules import NO_VIOLATION
from equipoise.safety.trial import new_trial_monitor, trial_violation
from equipoise.safety.trial import reset_trial_monitor as compilable_reset
from equipoise.safety.trial import setpoint_violation as compilable_setpoint_violation
from equipoise.settings import Settings, changed
from equipoise.simulation import setup_of, simulate


@kernel
def reset_trial_monitor(monitor, q):
    """Begin a trial, as kernels do it."""
    compilable_reset(monitor, q)


@kernel
def setpoint_violation(monitor, q, now):
    """Return the rule that forbids a setpoint, as kernels do it."""
    return compilable_setpoint_violation(monitor, q, now)


@kernel
def violation(monitor, controller, records, q, measured_at):
    """Return the rule that ends the trial, as kernels do it."""
    return trial_violation(monitor, controller, records[0], q, measured_at)


ARM = iiwa(7)
GUARD_7 = rules.make_safety_params(ARM, reaction=0.03, h=0.01)
DT = 0.005


def numbers(wide):
    return st.tuples(*(st.floats(-wide, wide) for _ in ARM.joints))


def same(violation, code, value, limit):
    """Whether a compiled verdict is that of Python."""
    if violation is None:
        return code == NO_VIOLATION
    evidence = violation.evidence["value"], violation.evidence["limit"]
    assert (value, limit) == pytest.approx(evidence, rel=1e-12)
    return SAFETY_RULES[code] is violation.outcome


@kernel
def compiled_setpoint(limits, q, last, before, dt):
    return rules.broken_setpoint(limits, q, last, before, dt)


@pytest.mark.compiled_only
@settings(deadline=None, max_examples=200)
@given(
    place=st.sampled_from([0.0, 1.0, 1.5, 2.0]),
    change=numbers(0.02),
    bend=numbers(3e-4),
    jump=st.sampled_from([0.0, 0.0, 0.0, 0.036]),
)
def test_a_setpoint_has_the_same_verdict_compiled_and_in_python(place, change, bend, jump):
    last = np.array(ARM.home) + place
    q = last + np.array(change) * 0.1 + jump
    before = last - np.array(change) * 0.1 + np.array(bend)
    violation = rules.check_setpoint(GUARD_7.limits, q.tolist(), tuple(last), tuple(before), DT)
    code, joint, value, limit = compiled_setpoint(GUARD_7.limits, q, last, before, DT)
    assert same(violation, code, value, limit)
    assert violation is None or joint == violation.evidence["joint"]


def test_a_number_that_is_none_breaks_a_rule():
    nan = float("nan")
    home = np.array(ARM.home)
    broken = home.copy()
    broken[3] = nan
    rule, joint, *_ = rules.broken_setpoint(GUARD_7.limits, broken, home, home, DT)
    assert (rule, joint) == (rules.POSITION_CODE, 4)
    assert rules.broken_flange(GUARD_7, nan, 0.0, 0.0, 0.0, 1.0)[0] == rules.TRACK_CODE
    assert rules.broken_flange(GUARD_7, 0.0, nan, 0.0, 0.0, 1.0)[0] == rules.TRACK_CODE
    assert rules.has_fallen(nan)


def test_the_rules_of_a_trial_have_the_numbers_of_a_rig():
    policy, world = shipped_policy(), read_world("twin:nominal")

    def safety(of_world=None, **of_task):
        numbers = world.settings.model_copy(update={"max_speed": of_world})
        settings = changed(policy.settings, of_task)
        setup = setup_of(policy, World("twin", numbers), settings)
        return simulate(World("twin", numbers), setup, seed=0, stream=0).safety

    guard = safety()
    assert guard.limits == GUARD_7.limits
    assert policy.actuator.delay.value < guard.reaction < 0.05
    assert guard.speed == float("inf")
    # Of two speed limits the lower acts.
    assert safety(0.23) == guard._replace(speed=0.23)
    for of_task, speed in ((0.3, 0.23), (0.2, 0.2)):
        assert safety(0.23, **{"plant.max_speed": of_task}) == guard._replace(speed=speed)


def test_what_may_not_be_sent_is_not_remembered_as_sent():
    watching, home = new_trial_monitor(ARM, GUARD_7), ARM.home_free.copy()
    reset_trial_monitor(watching, home)
    assert setpoint_violation(watching, home, 0.0) == NO_VIOLATION
    assert setpoint_violation(watching, home + 1e-5, 0.005) == NO_VIOLATION
    far = home + 1e-5
    far[2] += 0.02
    assert SAFETY_RULES[setpoint_violation(watching, far, 0.01)] is Outcome.VELOCITY
    newest = rules.newest_before(watching.states["sent"][0], int(watching.states["number"][0]), 1.0)
    assert watching.states["setpoints"][0, newest] == pytest.approx(home + 1e-5)
    assert SAFETY_RULES[setpoint_violation(watching, home + 6e-4, 0.01)] is Outcome.ACCELERATION


class Tick:
    """The first lane of a controller, told what it measures and believes."""

    def __init__(self, guard=GUARD_7, begin=(0.0,) * 6):
        self.controller = make_controller_params(
            ARM, Settings(), IDEAL_ACTUATOR, PendulumParameters(70.2, 7.16, 0.15), h=0.01,
            counts_per_rev=8192,
        )  # fmt: skip
        self.records, self.watching = new_records(ControllerState), new_trial_monitor(ARM, guard)
        self.memory = fields(self.records, ControllerState)
        self.memory.balancing[0] = 1
        reset_trial_monitor(self.watching, ARM.home_free + begin)

    def __call__(self, away=(0.0,) * 6, v=0.0, phi=0.0, measured_at=0.0):
        """Return the rule that ends the run, or none; joints are told as seen from home [rad]."""
        q = ARM.home_free + away
        self.memory.measured[:, 0] = q
        self.memory.estimate.pivot_v[0], self.memory.estimate.phi[0] = v, phi
        code = violation(self.watching, self.controller, self.records, q, measured_at)
        return None if code == NO_VIOLATION else SAFETY_RULES[code]


def test_a_pendulum_that_is_swung_up_has_not_fallen():
    tick = Tick()
    tick.memory.balancing[0] = 0
    assert tick(phi=3.0) is None
    assert tick(phi=3.0, v=1.2) is Outcome.TRACK


def joint(row, by):
    return np.eye(6)[row] * by


@pytest.mark.parametrize(
    ("rule", "kept", "not_kept"),
    [
        # To rest from 1 m/s it takes 187 mm, from 1.2 m/s 254 mm.
        (Outcome.TRACK, {"v": 1.0}, {"v": 1.2}),
        (Outcome.TRACK, {"v": -1.0}, {"v": -1.2}),
        (Outcome.ANGLE, {"phi": radians(10.9)}, {"phi": radians(11.0)}),
        (Outcome.ANGLE, {"phi": -radians(10.9)}, {"phi": -radians(11.0)}),
        # The first joint takes the flange, 0.59 m away, along its track, the second one, 0.61 m
        # away, off its line; the last one tilts it.
        (Outcome.TRACK, {"away": joint(0, 0.02)}, {"away": joint(0, 0.4)}),
        (Outcome.DRIFT, {"away": joint(1, 0.024)}, {"away": joint(1, 0.025)}),
        (Outcome.TILT, {"away": joint(5, radians(1.9))}, {"away": joint(5, radians(2.1))}),
        (Outcome.TRACK, {}, {"v": 1.2, "phi": 1.0}),
    ],
)
def test_a_trial_ends_where_a_rig_would_stop(rule, kept, not_kept):
    assert Tick(begin=kept.get("away", joint(0, 0.0)))(**kept) is None
    assert Tick(begin=not_kept.get("away", joint(0, 0.0)))(**not_kept) is rule
    slow = GUARD_7._replace(speed=0.23)
    assert Tick(slow)(v=0.229) is None
    assert Tick(slow)(v=-0.231) is Outcome.SPEED


def test_a_trial_ends_where_the_arm_is_elsewhere_for_long():
    tick, off = Tick(), joint(3, 0.031)
    assert [tick() for _ in range(10)] == [None] * 10
    assert [tick(off) for _ in range(6)] == [None] * 5 + [Outcome.FOLLOWING]
    begun = Tick()
    assert [begun(off) for _ in range(5)] == [None] * 5
    reset_trial_monitor(begun.watching, ARM.home_free)
    assert begun(off) is None, "another trial has not been elsewhere yet"


@pytest.mark.parametrize(("measured_at", "error_time"), [(1.029, False), (1.031, True)])
def test_an_arm_is_expected_where_it_was_sent_before_its_reaction(measured_at, error_time):
    wide = (1e9,) * 7
    limits = GUARD_7.limits._replace(velocity=wide, acceleration=wide)
    tick = Tick(GUARD_7._replace(limits=limits))
    assert setpoint_violation(tick.watching, ARM.home_free + joint(4, 0.034), 1.0) == NO_VIOLATION
    said = {tick(measured_at=measured_at) for _ in range(6)}
    assert (Outcome.FOLLOWING in said) == error_time
