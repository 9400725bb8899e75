"""`equipoise gap`: what it says, what it leaves, and what it refuses."""

import pytest

from equipoise.control.policy import TabularPolicy
from equipoise.executors import ThreadExecutor
from equipoise.model.actuator import Actuator
from equipoise.studies import gap as study
from equipoise.studies.gap_results import Gap, sentences
from tests.apps.report.made_up_gap import falls_early, measured, paper_policy, with_cures
from tests.cli.damage import DAMAGE

FEW = ("learning.episodes=20", "selection.every=10", "selection.rounds=1")
SHORT = ("selection.round_trials=2", "selection.duration=1")


@pytest.fixture
def cured_file(small_policy, tmp_path):
    path = tmp_path / "policy.json"
    with_cures(small_policy).save(path, command="test")
    return path


@pytest.fixture
def paper_file(small_policy, tmp_path):
    path = tmp_path / "paper.json"
    paper_policy(small_policy).save(path, command="test")
    return path


@pytest.fixture
def made_up(monkeypatch):
    """The study runs no trials: a rule says how long they last."""
    options = {}

    def gap(policy, **given):
        options.update(given)
        return measured(policy, falls_early, **given)[0]

    monkeypatch.setattr(study, "gap", gap)
    return options


@pytest.mark.compiled_only
def test_a_short_study_is_left_with_its_figure_and_the_table_that_it_trained(
    equipoise, cured_file, tmp_path, monkeypatch
):
    monkeypatch.setattr(study, "BEST_TABLE_QUICK", (*FEW, *SHORT))
    ran = equipoise("gap", cured_file, "--quick", "--trials", 2, "--duration", 0.3)
    assert ran.code == 0, ran
    gap = Gap.load(tmp_path / "gap.json")
    table = TabularPolicy.load(tmp_path / "gap-paper-policy.json")
    assert (gap.paper_policy, gap.policy) == (table.digest, TabularPolicy.load(cured_file).digest)
    assert "paper" in table.recipe
    assert (gap.trials, gap.duration, gap.quick) == (2, 0.3, True)
    assert (tmp_path / "gap.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "gap.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert "wrote gap.json, gap.svg, gap.png and gap-paper-policy.json" in ran.out


def test_it_says_the_tables_and_the_words(equipoise, cured_file, paper_file, made_up, tmp_path):
    ran = equipoise("gap", cured_file, "--paper-policy", paper_file, "--out", "mine.json")
    assert ran.code == 0, ran
    gap = Gap.load(tmp_path / "mine.json")
    said = " ".join(ran.out.split())
    for sentence in sentences(gap):
        assert " ".join(sentence.split()) in said
    # 90 / (1 + 800 * 0.03) s, and half of the falls on the track.
    assert "3.7 (50)" in ran.out
    for row in ("no prediction", "paper, clean twin", "transport delay", "dry friction"):
        assert row in ran.out
    assert "40 trials of 60 s at each point, on the iiwa14, world twin:nominal, seed 0" in ran.out
    assert "wrote mine.json, mine.svg and mine.png" in ran.out
    assert not (tmp_path / "mine-paper-policy.json").exists()
    assert "--claim 0.99" in ran.out


def test_options_reach_the_study(equipoise, cured_file, paper_file, made_up, tmp_path):
    actuator = Actuator.assumed("kst", delay=0.03, lag=0.008)
    actuator.save(tmp_path / "actuator.json", command="test")
    options = ("--world", "twin:harsh", "--actuator", "actuator.json", "--trials", 5, "--seed", 9)
    other = ("--duration", 30, "--quick", "--workers", 3, "--paper-policy", paper_file)
    ran = equipoise("gap", cured_file, *options, *other)
    assert ran.code == 0, ran
    assert made_up["actuator"] == actuator
    chosen = {name: made_up[name] for name in ("world", "trials", "seed", "duration", "workers")}
    assert chosen == {
        "world": "twin:harsh",
        "trials": 5,
        "seed": 9,
        "duration": 30.0,
        "workers": ThreadExecutor(3),
    }
    assert made_up["quick"]
    assert "warning" not in ran.out


def test_an_actuator_of_another_twin_is_warned_of(equipoise, cured_file, paper_file, made_up):
    ran = equipoise("gap", cured_file, "--world", "twin:harsh", "--paper-policy", paper_file)
    assert "warning: the cures assume a delay of 10.0 ms, and twin:harsh has 30.0 ms" in ran.out


def test_json_is_one_object_with_a_point_for_each_condition(
    equipoise, cured_file, paper_file, made_up
):
    found = equipoise("gap", cured_file, "--paper-policy", paper_file, "--json").json
    assert found["files"] == ["gap.json", "gap.svg", "gap.png"]
    assert (found["trials"], found["duration"], found["quick"]) == (40, 60.0, False)
    late = [
        point
        for point in found["points"]
        if (point["part"], point["controller"], point["at"]) == ("delay", "paper", 0.03)
        and point["on_clean"]
    ]
    assert len(late) == 1
    assert late[0]["mean_s"] == pytest.approx(90.0 / 25.0 + 0.1, abs=0.01)
    assert late[0]["interval_s"][0] < late[0]["mean_s"] < late[0]["interval_s"][1]
    assert late[0]["track_share"] == 0.5
    assert late[0]["causes"] == {"track": 20, "angle": 20}
    assert len(found["words"]) == 10


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_policy_is_refused(refused, cured_file, damage):
    damage(cured_file)
    refused("gap", cured_file, saying=DAMAGE[damage])


OPTIONS = {
    "the plant of the training": (("--world", "model"), "lies between model and a twin"),
    "unknown world": (("--world", "mars"), "there is no world 'mars'"),
    "one trial": (("--trials", "1"), "--trials"),
    "a billion trials": (("--trials", 10**9), "1000000000"),
    "trials beyond any integer": (("--trials", 10**30), "1,000,000"),
    "no duration": (("--duration", "0"), "--duration is 0.0 s"),
    "an endless duration": (("--duration", "inf"), "--duration is inf s"),
    "a table with an actuator": (("--paper-policy", "policy.json"), "trained with an actuator"),
    "no table": (("--paper-policy", "nowhere.json"), "there is no file nowhere.json"),
    "no actuator": (("--actuator", "policy.json"), "expected 'equipoise-actuator'"),
    "output is no JSON": (("--out", "gap.png"), "ends in .json"),
    "output is the policy": (("--out", "policy.json"), "would be written over"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, cured_file, flaw):
    options, saying = OPTIONS[flaw]
    refused("gap", cured_file, *options, saying=saying)


def test_a_policy_without_cures_is_refused(refused, small_policy, paper_file):
    refused("gap", paper_file, "--paper-policy", paper_file, saying="no cures to leave out")


def test_the_table_that_is_trained_is_not_written_over_the_policy(refused, cured_file):
    beside = cured_file.rename(cured_file.with_name("gap-paper-policy.json"))
    refused("gap", beside, "--force", saying="would be written over")
