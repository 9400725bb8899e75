"""Public values in an interactive session: one line, and paths as text."""

import re
from pathlib import Path

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


def test_paths_as_text_are_taken_by_all_that_reads_and_writes(values, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, value in values.items():
        value.save(f"deep/{name}", command="test")
        assert type(value).load(f"deep/{name}").digest == value.digest
    swing = eq.simulate_swing(
        eq.PendulumParameters(70.2, 7.16, 0.1),
        theta0=0.7,
        duration=2.0,
        rate_hz=100.0,
        counts_per_rev=8192,
    )
    eq.write_swing("swing.csv", swing)
    assert len(eq.read_swing("swing.csv").time) == len(swing.time)
    Path("settings.toml").write_text("[learning]\ngamma = 0.9\n")
    assert eq.resolve(file="settings.toml").learning.gamma == 0.9
    with pytest.raises(eq.EquipoiseError, match=r"arm\.urdf"):
        eq.read_urdf("arm.urdf")
    world = eq.resolve(overrides=["evaluation.trials=2", "evaluation.duration=0.1"])
    assert eq.evaluate(values["policy"], world)
