"""Public values in an interactive session: one line, and paths as text."""

import re

import pytest

import equipoise as eq
from equipoise.model.worlds import MODEL


@pytest.fixture(scope="module")
def values(small_policy, pendulum):
    """One value of each kind."""
    settings = eq.resolve(overrides=["evaluation.trials=4", "evaluation.duration=1"])
    return {
        "pendulum": pendulum,
        "identified": eq.shipped_pendulum(),
        "policy": small_policy,
        "evaluation": eq.evaluate(small_policy, settings, with_baselines=False),
        "run": eq.simulate_run(small_policy, world=MODEL, duration=1.0),
    }


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pendulum", r"<Pendulum w2=70\.2, k=7\.158, c=0\.15, coulomb=0, drag=0, assumed>"),
        ("identified", r"<Pendulum w2=70\.\d+, .*, from 'simulated swing'>"),
        ("policy", r"<TabularPolicy of 'iiwa14', 120 episodes>"),
        (
            "evaluation",
            r"<Evaluation of 'policy' in 'model': \d of 4 trials lasted 1 s .*>",
        ),
        ("run", r"<RunLog of 'iiwa14' in 'model': lasted \S+ of 1 s, ended [a-z ]+>"),
    ],
)
def test_a_value_is_one_line(values, name, expected):
    for text in (repr(values[name]), str(values[name])):
        assert re.fullmatch(expected, text)
        assert len(text) < 140
