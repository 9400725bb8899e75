"""`equipoise reproduce`: the folder it leaves, the verdict it prints, and what it refuses.

What stands in the report is tested with the study and the report.
"""

import pytest

from equipoise.control.policy import TabularPolicy
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.studies import gap as study
from equipoise.studies import reproduction
from equipoise.studies.gap_results import Gap
from equipoise.studies.results import StageRecord
from equipoise.worlds.evaluation import Evaluation
from tests.cli.conftest import COSINE, TIME

SHORT = (
    "--quick",  # which also cuts the study of the gap down
    "--set=learning.episodes=40",
    "--set=learning.episode_duration=1",
    "--set=selection.every=20",
    "--set=selection.round_trials=4",
    "--set=selection.rounds=1",
    "--set=selection.duration=1",
    "--set=evaluation.trials=4",
    "--set=evaluation.duration=1",
)
READ = {
    "pendulum.json": Pendulum,
    "policy.json": TabularPolicy,
    "evaluation.json": Evaluation,
    "run.mcap": RunLog,
    "gap.json": Gap,
    "reproduction.json": StageRecord,
}
FILES = ("swing.csv", *READ, "report.html")


@pytest.fixture(autouse=True)
def tiny_gap(monkeypatch):
    """Neither look long for the table of the paper nor run long trials of it."""
    quickly = (*study.BEST_TABLE_QUICK, "learning.episodes=20", "selection.every=10")
    monkeypatch.setattr(study, "BEST_TABLE_QUICK", quickly)
    monkeypatch.setattr(reproduction, "QUICK_GAP", (2, 0.1))


def test_it_leaves_every_file_and_says_what_came_out(equipoise, tmp_path):
    ran = equipoise("reproduce", *SHORT, "--out", "paper")
    assert ran.code in (0, 1)
    assert all((tmp_path / "paper" / name).stat().st_size for name in FILES)
    assert ran.out.count("\n- ") == 5  # the verdict
    assert "wrote paper/report.html" in ran.out
    assert ran.out.splitlines()[-1].startswith("next: equipoise ")
    for name, kind in READ.items():
        assert kind.load(tmp_path / "paper" / name).digest


@pytest.mark.slow
def test_a_recorded_swing_json_and_the_exit_code(equipoise, swing):
    ran = equipoise("reproduce", "--swing", swing, *SHORT, "--json")
    found = ran.json
    assert found["out"] == "equipoise-report"
    assert len(found["verdict"]) == 5
    assert "recorded" in " ".join(found["verdict"])
    assert ran.code == (0 if found["median_s"] >= found["duration"] else 1)
    assert ran.err == ""
    assert found["world"] == "twin:nominal"
    assert 0.0 < found["lasted_s"] <= 1.0
    assert found["outcome"] in ("lasted", "angle", "track", "joint limit")


OPTIONS = {
    "unknown recipe": (("--recipe", "magic"), "there is no recipe 'magic'"),
    "unknown arm": (("--arm", "iiwa"), "there is no arm 'iiwa'"),
    "unknown setting": (("--set", "plant.noise=1"), "there is no setting 'plant.noise'"),
    "missing swing": (("--swing", "nowhere.csv"), "there is no file nowhere.csv"),
    "no workers": (("--workers", "0"), "--workers"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, flaw):
    options, saying = OPTIONS[flaw]
    refused("reproduce", *options, saying=saying)


def test_a_swing_that_identifies_nothing_is_refused(refused, csv):
    path = csv("time_s,counts", TIME, COSINE)
    refused("reproduce", "--swing", path, saying="--counts-per-rev")


def test_a_folder_that_cannot_be_is_refused(refused, tmp_path):
    (tmp_path / "file").write_text("")
    refused("reproduce", "--out", "file", saying="is a file")
    refused("reproduce", "--out", "file/paper", saying="cannot write in")


def test_options_of_a_recording_without_one_are_refused(refused):
    refused("reproduce", "--counts-per-rev", "4096", saying="--swing")
