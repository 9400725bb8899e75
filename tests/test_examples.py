"""The examples run as they are printed, in an empty folder."""

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
PIPELINE = "pipeline.py"  # docs/tutorial.md links it
LONG = (PIPELINE, "train_and_evaluate.py")
SAY = {
    PIPELINE: "200 of 200 trials survived 60 s",
    "identify_a_swing.py": "w2 = m g l / I",
    "train_and_evaluate.py": "LQR, snapped survived 200 of 200 trials",
    "own_policy.py": "5 of 5 trials survived 10 s",
    "policy_table.py": "    -10     10     50    inf",
    "foxglove.py": "open it in Foxglove",
    "deploy_on_the_twin.py": "twin:nominal: survived 20 of 20 s",
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
