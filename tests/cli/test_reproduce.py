"""`equipoise reproduce`: the folder it leaves, the verdict it prints, and its refusals."""

import pytest

from equipoise.reproduction.results import load
from tests.cli.conftest import COSINE, TIME

SHORT = (
    "--quick",
    "--set=learning.episodes=40",
    "--set=learning.episode_duration=1",
    "--set=selection.every=20",
    "--set=selection.round_trials=4",
    "--set=selection.rounds=1",
    "--set=selection.duration=1",
    "--set=evaluation.trials=4",
    "--set=evaluation.duration=1",
)


def test_it_leaves_every_file_and_prints_the_verdict(equipoise, tmp_path):
    ran = equipoise("reproduce", *SHORT, "--out", "paper")
    assert ran.code in (0, 1)
    found = load(tmp_path / "paper")
    assert found.policy.digest in found.record.files.values()
    assert (tmp_path / "paper" / "report.html").stat().st_size
    assert ran.out.count("\n- ") >= 5  # the verdict
    assert "wrote paper/report.html" in ran.out


@pytest.mark.slow
def test_a_recorded_swing_json_and_the_exit_code(equipoise, swing):
    ran = equipoise("reproduce", "--swing", swing, *SHORT, "--json")
    found = ran.json
    assert found["out"] == "equipoise-report"
    assert ran.code == (0 if found["median_s"] >= found["duration"] else 1)
    assert ran.err == ""
    assert found["world"] == "twin:nominal"
    assert 0.0 < found["lasted_s"] <= 1.0


REFUSED = {
    "unknown recipe": (("--recipe", "magic"), "magic"),
    "unknown arm": (("--arm", "iiwa"), "iiwa"),
    "missing swing": (("--swing", "nowhere.csv"), "nowhere.csv"),
    "a file as the folder": (("--out", "file"), "file"),
    "options of a recording without one": (("--counts-per-rev", "4096"), "--swing"),
    "a swing that identifies nothing": (("--swing", "still.csv"), "--counts-per-rev"),
}


@pytest.mark.parametrize("flaw", REFUSED)
def test_bad_input_is_refused(refused, csv, tmp_path, flaw):
    (tmp_path / "file").write_text("")
    csv("time_s,counts", TIME, COSINE, name="still.csv")
    options, saying = REFUSED[flaw]
    refused("reproduce", *options, saying=saying)
