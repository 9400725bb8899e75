"""The examples run as they are printed, in an empty folder."""

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
PIPELINE = "pipeline.py"  # docs/tutorial.md links it
LONG = (PIPELINE, "train_and_evaluate.py", "lqr.py", "mpc.py", "swing_up.py", "arm_from_a_urdf.py")
PICTURED = ("lqr", "mpc", "delay_of_a_log", "swing_up", "arm_from_a_urdf")
SAY = {
    PIPELINE: "200 of 200 trials survived 60 s",
    "identify_a_swing.py": "w2 = m g l / I",
    "train_and_evaluate.py": "LQR, snapped survived 200 of 200 trials",
    "own_policy.py": "5 of 5 trials survived 10 s",
    "policy_table.py": "    -10     10     50    inf",
    "foxglove.py": "open it in Foxglove",
    "deploy_on_the_twin.py": "twin:nominal: survived 20 of 20 s",
    "lqr.py": "LQR: survived after 10 s",
    "mpc.py": "MPC: survived after 10 s",
    "delay_of_a_log.py": "a setpoint acts after 10.0 ms (95 %: 9.9 to 10.1 ms), by the law kst",
    "swing_up.py": "from hanging: survived",
    "arm_from_a_urdf.py": "elbow 6, 6 joints: survived after 10 s",
}


@pytest.fixture
def example(monkeypatch, capsys):
    """Run an example as a script; return what it prints."""

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
    assert [path.stem for path in Path().glob("*.png")] == [name[:-3]] * (name[:-3] in PICTURED)
