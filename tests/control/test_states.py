"""The states of a run: each move that there is, and none that there is not."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.control.states import (
    LATCHED,
    STREAMING,
    TRANSITIONS,
    UNKNOWN,
    Cause,
    Phase,
    RunEvent,
    RunState,
    step,
)

WAY = [
    (RunEvent.START, Phase.HOMING),
    (RunEvent.ARRIVED, Phase.AT_HOME),
    (RunEvent.CONFIRMED, Phase.REFERENCING),
    (RunEvent.REFERENCED, Phase.SELF_TEST),
    (RunEvent.PASSED, Phase.LIFTING),
    (RunEvent.ARMED, Phase.ARMED),
    (RunEvent.RELEASED, Phase.BALANCING),
    (RunEvent.STOP, Phase.STOPPING),
    (RunEvent.AT_REST, Phase.STOPPED),
    (RunEvent.REARMED, Phase.IDLE),
]
"""The whole of a good run, typed from the issue."""
ALLOWED = {
    *zip([Phase.IDLE, *(phase for _, phase in WAY)], *zip(*WAY, strict=True), strict=False),
    (Phase.SELF_TEST, RunEvent.REFUSED, Phase.REFERENCING),
    (Phase.SELF_TEST, RunEvent.EXCITED, Phase.EXCITING),
    (Phase.EXCITING, RunEvent.PASSED, Phase.LIFTING),
    (Phase.ARMED, RunEvent.DENIED, Phase.LIFTING),
    (Phase.IDLE, RunEvent.STOP, Phase.STOPPED),
    *(
        (phase, RunEvent.STOP, Phase.STOPPING)
        for phase in Phase
        if phase not in (Phase.IDLE, Phase.STOPPED, Phase.LOST)
    ),
    *((phase, RunEvent.LOST, Phase.LOST) for phase in Phase),
}
KEY = Cause("key", "a key was pressed")
FROZEN = Cause("not following", "the arm stands still", from_measured=True)


def test_a_good_run_goes_its_way():
    state = RunState()
    for event, phase in WAY:
        state = step(state, event)
        assert state.phase is phase


@pytest.mark.parametrize(("phase", "event"), list(product(Phase, RunEvent)))
def test_there_is_no_other_move(phase, event):
    before = RunState(phase)
    after = step(before, event, KEY)
    moves = {end for begin, by, end in ALLOWED if (begin, by) == (phase, event)}
    assert {after.phase} == (moves or {phase})
    if not moves:
        assert after is before


def test_the_table_holds_nothing_else():
    assert {(begin, event, end) for (begin, event), end in TRANSITIONS.items()} == ALLOWED


def test_setpoints_are_sent_where_the_servo_runs_and_nowhere_else():
    assert {Phase.HOMING, Phase.BALANCING, Phase.STOPPING} <= STREAMING
    assert set(Phase) - STREAMING == {Phase.IDLE, Phase.STOPPED, Phase.LOST}


@pytest.mark.parametrize("phase", sorted(STREAMING - LATCHED, key=str))
def test_every_streaming_state_can_be_stopped(phase):
    state = step(RunState(phase), RunEvent.STOP, KEY)
    assert state == RunState(Phase.STOPPING, KEY)
    assert state.latched
    assert state.phase in STREAMING


def test_the_first_cause_stays():
    state = step(RunState(Phase.BALANCING), RunEvent.STOP, KEY)
    state = step(state, RunEvent.STOP, FROZEN)
    assert state.cause is KEY
    # ... but what comes later about the arm is believed.
    assert state.from_measured
    state = step(state, RunEvent.STOP, KEY)
    assert state.from_measured
    state = step(step(state, RunEvent.AT_REST), RunEvent.LOST, FROZEN)
    assert state == RunState(Phase.LOST, KEY, from_measured=True)


def test_re_arming_begins_anew():
    state = step(RunState(Phase.BALANCING), RunEvent.STOP, FROZEN)
    assert state.from_measured
    state = step(step(state, RunEvent.AT_REST), RunEvent.REARMED)
    assert state == RunState()


def test_a_stop_without_a_cause_believes_the_worst():
    state = step(RunState(Phase.BALANCING), RunEvent.STOP)
    assert state.cause is UNKNOWN
    assert state.from_measured


def test_most_causes_leave_the_arm_where_it_was_sent():
    assert not Cause("key", "a key was pressed").from_measured
    assert not RunState().from_measured
    assert not step(RunState(Phase.BALANCING), RunEvent.STOP, KEY).from_measured


def test_a_cause_of_another_event_is_no_cause():
    assert step(RunState(), RunEvent.START, KEY).cause is None


@given(
    st.sampled_from(sorted(LATCHED, key=str)),
    st.lists(st.sampled_from([event for event in RunEvent if event is not RunEvent.REARMED])),
)
def test_nothing_but_the_operator_opens_a_latch(phase, events):
    state = RunState(phase, KEY)
    for event in events:
        state = step(state, event, FROZEN)
        assert state.latched
        assert state.cause is KEY


@given(st.lists(st.sampled_from(RunEvent)))
def test_what_is_lost_stays_lost(events):
    state = RunState(Phase.LOST, KEY)
    for event in events:
        state = step(state, event, FROZEN)
        assert state.phase is Phase.LOST
