"""Policies: what each kind commands, and the table as a file."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise import paper, shipped_policy
from equipoise.control.policy import LINEAR, RANDOM, SNAPPED, PolicyKernel, TabularPolicy, act
from equipoise.settings import BoxSettings, Settings
from tests.reference.intervals import place

STATE = (0.0, 0.0, 0.01, 0.0)
states = st.tuples(
    st.floats(-0.219, 0.219), st.floats(-2, 2), st.floats(-0.19, 0.19), st.floats(-9, 9)
)


def table(values=None, **changes):
    """Return the fields of the shipped policy with a table of random values, and other changes."""
    if values is None:
        values = np.random.default_rng(1).normal(size=(270, 8))
    fields = {name: getattr(shipped_policy(), name) for name in TabularPolicy.model_fields}
    return fields | {"Q": tuple(map(tuple, values.tolist()))} | changes


# What each kind commands


@given(state=states, gains=st.tuples(*[st.floats(-50, 50)] * 4))
def test_a_linear_policy_is_clipped_to_the_range_of_the_actions(state, gains):
    u = act(PolicyKernel(LINEAR, gains=gains), state, 0.0)
    assert u == pytest.approx(float(np.clip(np.dot(gains, state), -2.0, 2.0)), abs=1e-12)


@given(state=states, gains=st.tuples(*[st.floats(-50, 50)] * 4))
def test_a_snapped_policy_takes_the_nearest_action(state, gains):
    u = act(PolicyKernel(SNAPPED, gains=gains), state, 0.0)
    wanted = np.dot(gains, state)
    distances = np.abs(np.array(paper.ACTIONS) - wanted)
    assert u in paper.ACTIONS
    assert abs(u - wanted) <= distances.min() + 1e-12


def test_a_random_policy_gives_each_action_the_same_share_of_the_chances():
    kernel = PolicyKernel(RANDOM)
    for i, action in enumerate(paper.ACTIONS):
        assert act(kernel, STATE, i / 8) == action
        assert act(kernel, STATE, np.nextafter((i + 1) / 8, 0)) == action


# The table as a file


@given(state=states)
def test_a_tabular_policy_takes_the_best_action_of_the_box(pendulum, state):
    Q = np.random.default_rng(1).normal(size=(270, 8))
    policy = TabularPolicy(**table(Q, pendulum=pendulum))
    x, x_dot, phi, phi_dot = state
    ahead = x + 0.5 * (x_dot + phi_dot / pendulum.parameters().k)
    ahead = min(max(ahead, -0.2199), 0.2199)
    best = Q.reshape(6, 5, 3, 3, 8)[place(ahead, x_dot, phi, phi_dot)].argmax()
    assert policy.act(np.array(state)) == paper.ACTIONS[best]
    assert isinstance(policy.act(np.array(state)), float)


def test_it_comes_back_from_its_file_with_every_bit(pendulum, tmp_path):
    policy, path = TabularPolicy(**table(pendulum=pendulum)), tmp_path / "policy.json"
    policy.act(np.zeros(4))
    policy.save(path, command="test")
    read = TabularPolicy.load(path)
    assert read == policy
    assert read.digest == policy.digest
    assert read.table.tobytes() == policy.table.tobytes()
    assert read.u_of_box.tobytes() == policy.u_of_box.tobytes()
    assert set(json.loads(path.read_text())["body"]) == set(TabularPolicy.model_fields)


ROW = (0.0,) * 8


@pytest.mark.parametrize(
    "changes",
    [
        {"Q": (ROW,) * 269},
        {"visits": ((0,) * 8,) * 271},
        {"actions": (*paper.ACTIONS, 3.0)},
        {"settings": Settings(boxes=BoxSettings(x=(-0.1, -0.05, 0.05, 0.1)))},
    ],
)
def test_a_table_that_does_not_fit_the_boxes_is_refused(pendulum, changes):
    with pytest.raises(ValueError, match=next(iter(changes)) if "settings" not in changes else "Q"):
        TabularPolicy(**table(pendulum=pendulum, **changes))
