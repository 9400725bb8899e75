"""`equipoise compare`: what it says, what it leaves, and what it refuses."""

import pytest

from equipoise.control.policy import TabularPolicy
from equipoise.studies import compare as study
from equipoise.studies.compare_results import Comparison
from equipoise.studies.table_search import SearchSize
from tests.studies.test_compare import FEW

SMALL = ("--quick", "--trials", 2, "--duration", 0.2, "--seed", 3)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(study, "QUICK_SETTINGS", FEW)
    monkeypatch.setattr(study, "QUICK", SearchSize(generations=1, tables=4, trials=1))


@pytest.mark.compiled_only
def test_a_comparison_is_left_with_its_figure_and_its_tables(equipoise, tmp_path):
    rows = ("--only", "sarsa, best-table, lqr", "--worlds", "ideal,model")
    ran = equipoise("compare", *SMALL, *rows)
    assert ran.code == 0, ran
    found = Comparison.load(tmp_path / "compare.json")
    assert [row.name for row in found.rows] == ["sarsa", "best-table", "lqr"]
    assert (found.trials, found.duration, found.quick, found.seed) == (2, 0.2, True, 3)
    for row in found.rows[:2]:
        assert TabularPolicy.load(tmp_path / f"compare-{row.name}.json").digest == row.policy
    assert (tmp_path / "compare.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "compare.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert "2 trials of 0.2 s each on the iiwa7, seed 3, the short form" in ran.out
    assert "100 [15.8, 100]" in ran.out
    for text in ("sarsa", "270 B", "32 B", "Root mean square of x", "model"):
        assert text in ran.out
    assert "wrote compare.json, compare.svg, compare.png, compare-sarsa.json and" in ran.out
    assert "search best-table" in ran.err
    assert "next: equipoise evaluate POLICY --claim 0.99" in ran.out


def test_json_has_a_row_for_each_policy_and_an_entry_for_each_world(equipoise, tmp_path):
    options = ("--only", "lqr,random", "--worlds", "model", "--no-figure", "--json")
    found = equipoise("compare", *SMALL, *options, "--out", "mine.json").json
    assert found["files"] == ["mine.json"]
    assert (found["trials"], found["duration"], found["seed"]) == (2, 0.2, 3)
    lqr, random = found["rows"]
    assert (lqr["name"], lqr["kind"], lqr["size"], lqr["steps"]) == ("lqr", "built in", 32, None)
    assert random["size"] == 0
    (world,) = lqr["worlds"]
    assert (world["world"], world["told"], world["survived"]) == ("model", False, 2)
    assert world["interval"] == pytest.approx([0.158, 1.0], abs=1e-3)
    assert world["rms_x"] > 0.0


def test_policies_of_others_are_rows_too(equipoise, tmp_path, monkeypatch):
    (tmp_path / "leaning.py").write_text("def law(seen):\n    return 2.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    options = ("--only", "none", "--worlds", "model", "--json")
    (row,) = equipoise("compare", "leaning:law", *SMALL, *options).json["rows"]
    assert (row["name"], row["kind"], row["size"]) == ("leaning:law", "given", None)


OPTIONS = {
    "an unknown row": (("--only", "dqn"), "there is no row 'dqn'"),
    "an empty name": (("--only", "lqr,,pd"), "has an empty name"),
    "no row at all": (("--only", "none"), "0 policies are to be compared"),
    "an unknown world": (("--only", "lqr", "--worlds", "model,mars"), "there is no world 'mars'"),
    "no such policy": (("nowhere.json", "--only", "none"), "there is no file nowhere.json"),
    "a billion trials": (("--trials", 10**9), "1000000000"),
    "an endless duration": (("--duration", "inf"), "--duration is inf s"),
    "output is no JSON": (("--out", "compare.png"), "ends in .json"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, flaw):
    options, saying = OPTIONS[flaw]
    refused("compare", *options, saying=saying)


def test_an_existing_table_is_kept(refused, tmp_path):
    (tmp_path / "mine-sarsa.json").write_text("{}")
    refused("compare", "--only", "sarsa", "--out", "mine.json", saying="mine-sarsa.json exists")
