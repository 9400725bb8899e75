"""The latch of a stop, in each phase of a run."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.control.policy import shipped_policy
from equipoise.outcomes import End, Outcome, Phase
from equipoise.rig.config import RigSettings
from equipoise.rig.phases.balancing import Balancing
from equipoise.rig.phases.context import RunContext
from equipoise.rig.phases.exciting import Exciting
from equipoise.rig.phases.preparation import Confirming, Homing, Referencing
from equipoise.rig.phases.release import Lifting
from equipoise.rig.phases.self_test import SelfTesting
from equipoise.rig.phases.stopping import Stopping
from equipoise.rig.request import RunRequest

pytestmark = pytest.mark.compiled_only

POLICY = shipped_policy()
HOME = POLICY.arm.home
REQUEST = RunRequest(POLICY, POLICY.actuator, RigSettings(), "twin:nominal", None, 60.0)
MAKE = {
    Phase.HOMING: Homing,
    Phase.AT_HOME: Confirming,
    Phase.REFERENCING: Referencing,
    Phase.SELF_TEST: lambda run: SelfTesting(run, Referencing),
    Phase.EXCITING: lambda run: Exciting(run, None),
    Phase.LIFTING: Lifting,
    Phase.BALANCING: Balancing,
}
KEY, FROZEN = End(Outcome.OPERATOR, {"typed": "stop"}), End(Outcome.NOT_FOLLOWING)


def context(kind):
    run = RunContext(REQUEST, HOME, counts_per_rev=8192)
    run.stopping, run.phase = Stopping(run), MAKE[kind](run)
    return run


@pytest.mark.parametrize("kind", MAKE)
def test_every_phase_can_be_stopped(kind):
    run = context(kind)
    assert run.phase.kind is kind
    on_track = run.phase.on_track
    setpoints = run.stop_and_rest(KEY, 0.0)
    assert (run.phase.kind, run.end, run.before.kind) == (Phase.STOPPING, KEY, kind)
    assert run.phase.on_track is on_track
    assert setpoints == (HOME, HOME)


@given(causes=st.lists(st.sampled_from([KEY, FROZEN]), min_size=1, max_size=5))
def test_nothing_opens_the_latch_and_the_first_cause_stays(causes):
    run = context(Phase.LIFTING)
    for cause in causes:
        run.stop(cause)
        for make in (Homing, Lifting):
            with pytest.raises(RuntimeError):
                run.go(make(run))
        assert (run.phase.kind, run.end) == (Phase.STOPPING, causes[0])
    # What comes later about the arm is believed.
    assert run.from_measured is (FROZEN in causes)
    assert [event.name for event in run.events] == ["stopping"]
