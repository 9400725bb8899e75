"""The examples run as they are printed, in an empty folder."""

import runpy
import sys
from pathlib import Path

import pytest

from equipoise.control.policy import shipped_policy
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import Pendulum

EXAMPLES = Path(__file__).parents[1] / "examples"
PIPELINE = "pipeline.py"  # docs/tutorial.md links it
LONG = (PIPELINE, "train_and_evaluate.py")
SAY = {
    PIPELINE: "200 of 200 trials lasted 60 s",
    "identify_a_swing.py": "w2 = m g l / I",
    "train_and_evaluate.py": "LQR, snapped lasted 200 of 200 trials",
    "own_policy.py": "5 of 5 trials lasted 10 s",
    "policy_table.py": "    -10     10     50    inf",
    "foxglove.py": "open it in Foxglove",
    "deploy_on_the_twin.py": "twin:nominal: stood 20 of 20 s",
}


@pytest.fixture
def example(tmp_path, monkeypatch, capsys):
    """Run an example as a script; return what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_every_example_is_run():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SAY)


@pytest.mark.compiled_only
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full if name in LONG else ()) for name in SAY]
)
def test_an_example_needs_no_file_and_says_what_it_should(example, name):
    assert SAY[name] in example(name)


def test_the_swing_of_the_first_example_gives_its_pendulum_back(example, tmp_path):
    example("identify_a_swing.py")
    found = Pendulum.load(tmp_path / "pendulum.json")
    assert found.w2.low < 70.2 < found.w2.high
    assert found.c.value == pytest.approx(0.1, rel=1e-3)  # its interval knows no encoder steps


def test_examples_take_files(example, small_policy, tmp_path):
    small_policy.save(tmp_path / "mine.json", command="test")
    assert "iiwa14, recipe custom: robust with learning.episodes = 120" in example(
        "policy_table.py", "mine.json"
    )


@pytest.mark.compiled_only
def test_a_run_on_the_twin_is_kept(example, tmp_path):
    example("deploy_on_the_twin.py")
    run = RunLog.load(tmp_path / "run.mcap")
    assert run.conditions.world == "twin:nominal"
    assert run.conditions.policy == shipped_policy().digest
