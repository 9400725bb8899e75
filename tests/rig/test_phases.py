"""The phases of a run: which may follow which, and the latch of a stop."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.control.control_step import horizon, make_controller_params
from equipoise.control.policy import shipped_policy, tick_policy
from equipoise.outcomes import End, Outcome, Phase
from equipoise.rig.phases.balancing import Balancing
from equipoise.rig.phases.context import ArmResponse, Excitation, RunContext, RunParts
from equipoise.rig.phases.exciting import Exciting
from equipoise.rig.phases.preparation import Confirming, Homing, Referencing
from equipoise.rig.phases.release import Armed, Lifting
from equipoise.rig.phases.self_test import SelfTesting
from equipoise.rig.phases.stopping import Stopping
from equipoise.rig.release import ReleaseDetector
from equipoise.safety.rules import make_safety_params

pytestmark = pytest.mark.compiled_only

POLICY = shipped_policy()
ARM, PENDULUM = POLICY.arm, POLICY.pendulum.parameters()
MAKE = {
    Phase.HOMING: Homing,
    Phase.AT_HOME: Confirming,
    Phase.REFERENCING: Referencing,
    Phase.SELF_TEST: lambda run: SelfTesting(run, Referencing),
    Phase.EXCITING: lambda run: Exciting(run, Excitation([ARM.home], None, None)),
    Phase.LIFTING: Lifting,
    Phase.ARMED: lambda run: Armed(run, ReleaseDetector(PENDULUM)),
    Phase.BALANCING: Balancing,
    Phase.STOPPING: Stopping,
}
FOLLOWING = {
    (Phase.HOMING, Phase.AT_HOME),
    (Phase.AT_HOME, Phase.REFERENCING),
    (Phase.REFERENCING, Phase.SELF_TEST),
    (Phase.SELF_TEST, Phase.REFERENCING),
    (Phase.SELF_TEST, Phase.EXCITING),
    (Phase.SELF_TEST, Phase.LIFTING),
    (Phase.EXCITING, Phase.LIFTING),
    (Phase.LIFTING, Phase.ARMED),
    (Phase.ARMED, Phase.LIFTING),
    (Phase.ARMED, Phase.BALANCING),
}
KEY, FROZEN = End(Outcome.OPERATOR, {"typed": "stop"}), End(Outcome.NOT_FOLLOWING)


@pytest.fixture(scope="module")
def response():
    own = POLICY.actuator
    params = make_controller_params(
        ARM, POLICY.settings, own, PENDULUM, h=POLICY.h, counts_per_rev=8192
    )
    reaction = horizon(ARM, own, 0.0)
    safety = make_safety_params(
        ARM, reaction=reaction, u_max=POLICY.u_max, h=POLICY.h, counts_per_rev=8192
    )
    return ArmResponse(own, params, safety)


def context(response, kind):
    parts = RunParts(ARM, POLICY.settings.boxes, tick_policy(POLICY), 60.0)
    run = RunContext(parts, response, ARM.home)
    run.stopping, run.phase = Stopping(run), MAKE[kind](run)
    return run


def test_each_phase_names_those_that_may_follow(response):
    made = {kind: context(response, kind).phase for kind in Phase}
    assert {kind: phase.kind for kind, phase in made.items()} == {kind: kind for kind in Phase}
    assert {(kind, after) for kind in Phase for after in made[kind].leads_to} == FOLLOWING


@pytest.mark.parametrize("kind", Phase)
def test_no_other_phase_follows(response, kind):
    for after in set(Phase) - {after for before, after in FOLLOWING if before is kind}:
        run = context(response, kind)
        with pytest.raises(RuntimeError):
            run.go(MAKE[after](run))
        assert run.phase.kind is kind


@pytest.mark.parametrize("kind", [each for each in Phase if each is not Phase.STOPPING])
def test_every_phase_can_be_stopped(response, kind):
    run = context(response, kind)
    on_track = run.phase.on_track
    setpoints = run.stop_and_rest(KEY, 0.0)
    assert (run.phase.kind, run.end, run.before.kind) == (Phase.STOPPING, KEY, kind)
    assert run.phase.on_track is on_track
    assert setpoints == (ARM.home, ARM.home)


@given(causes=st.lists(st.sampled_from([KEY, FROZEN]), min_size=1, max_size=5))
def test_nothing_opens_the_latch_and_the_first_cause_stays(response, causes):
    run = context(response, Phase.LIFTING)
    for cause in causes:
        run.stop(cause)
        with pytest.raises(RuntimeError):
            run.go(Lifting(run))
        assert (run.phase.kind, run.end) == (Phase.STOPPING, causes[0])
    # What comes later about the arm is believed.
    assert run.from_measured is (FROZEN in causes)
    assert [event.name for event in run.events] == ["stopping"]
