"""The phases of a run: each move that there is, and none that there is not."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.control.states import TRANSITIONS, RunEvent, RunState, step, stop
from equipoise.outcomes import End, Outcome, Phase

WAY = [
    (RunEvent.ARRIVED, Phase.AT_HOME),
    (RunEvent.CONFIRMED, Phase.REFERENCING),
    (RunEvent.REFERENCED, Phase.SELF_TEST),
    (RunEvent.PASSED, Phase.LIFTING),
    (RunEvent.ARMED, Phase.ARMED),
    (RunEvent.RELEASED, Phase.BALANCING),
]
"""The whole of a good run."""
ALLOWED = {
    *zip([Phase.HOMING, *(phase for _, phase in WAY)], *zip(*WAY, strict=True), strict=False),
    (Phase.SELF_TEST, RunEvent.REFUSED, Phase.REFERENCING),
    (Phase.SELF_TEST, RunEvent.EXCITED, Phase.EXCITING),
    (Phase.EXCITING, RunEvent.PASSED, Phase.LIFTING),
    (Phase.ARMED, RunEvent.DENIED, Phase.LIFTING),
}
KEY = End(Outcome.OPERATOR)
FROZEN = End(Outcome.NOT_FOLLOWING)


def test_a_good_run_goes_its_way():
    state = RunState()
    for event, phase in WAY:
        state = step(state, event)
        assert state.phase is phase


@pytest.mark.parametrize(("phase", "event"), list(product(Phase, RunEvent)))
def test_there_is_no_other_move(phase, event):
    moves = {end for begin, by, end in ALLOWED if (begin, by) == (phase, event)}
    assert {step(RunState(phase), event).phase} == (moves or {phase})


def test_the_table_holds_nothing_else():
    assert {(begin, event, end) for (begin, event), end in TRANSITIONS.items()} == ALLOWED


@pytest.mark.parametrize("phase", Phase)
def test_every_phase_can_be_stopped(phase):
    state = stop(RunState(phase), KEY)
    assert state == RunState(Phase.STOPPING, KEY)
    assert state.latched
    assert RunState(phase).latched is (phase is Phase.STOPPING)


def test_the_first_cause_stays():
    state = stop(stop(RunState(Phase.BALANCING), KEY), FROZEN, from_measured=True)
    assert state.cause is KEY
    # ... but what comes later about the arm is believed.
    assert state.from_measured
    assert stop(state, KEY).from_measured
    assert not stop(RunState(Phase.BALANCING), KEY).from_measured


@given(st.lists(st.sampled_from([*RunEvent, KEY, FROZEN])))
def test_no_event_opens_a_latch(events):
    state = stop(RunState(Phase.BALANCING), KEY)
    for event in events:
        state = stop(state, event) if isinstance(event, End) else step(state, event)
        assert state.latched
        assert state.cause is KEY
