"""The verb `equipoise sweep`."""

import json
import sys

import pytest

from equipoise.cli import main
from equipoise.studies.sweep_results import Sweep

STUDY = """
sampler = "grid"
tests = 4
duration = 0.5
[settings]
learning.episodes = 10
selection.every = 0
[parameters]
learning.gamma = { choices = [0.9, 0.99] }
boxes.look_ahead = { low = 0.0, high = 0.5, step = 0.5 }
"""


@pytest.fixture(autouse=True)
def _study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY)


def test_a_sweep_writes_result_figure_and_storage(tmp_path, capsys):
    code = main(["sweep", "study.toml", "--json"])
    printed = json.loads(capsys.readouterr().out)
    found = Sweep.load("sweep.json")
    best = found.ranking[0]
    assert code == (0 if best.survived else 1)
    assert printed["best"]["index"] == best.index
    assert [trial["index"] for trial in printed["trials"]] == [0, 1, 2, 3]
    names = ["sweep.json", "sweep.png", "sweep.sqlite3", "sweep.svg"]
    assert sorted(path.name for path in tmp_path.glob("sweep.*")) == names


def test_a_bad_study_is_one_clear_error(tmp_path, capsys):
    (tmp_path / "study.toml").write_text(STUDY.replace("gamma", "gama"))
    assert main(["sweep", "study.toml"]) == 2
    error = capsys.readouterr().err
    assert "there is no setting 'learning.gama'; did you mean 'gamma'?" in " ".join(error.split())
    assert not list(tmp_path.glob("sweep.*"))


def test_a_missing_optuna_is_named_with_its_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(["sweep", "study.toml"]) == 2
    assert "python -m pip install optuna" in " ".join(capsys.readouterr().err.split())
