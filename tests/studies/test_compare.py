"""The comparison: equal trials and budgets for all, costs, and what is refused."""

import pytest

from equipoise.control.bound_policy import load_policy
from equipoise.errors import InputError, SettingsError
from equipoise.model.actuator import IDEAL_ACTUATOR, shipped_actuator
from equipoise.model.worlds import read_world
from equipoise.studies import compare as study
from equipoise.studies.compare import TRAINED, compare, settings_of, size_of, trials_of
from equipoise.studies.compare_results import Comparison
from equipoise.studies.table_search import SearchSize
from equipoise.worlds.evaluation import evaluate
from equipoise.worlds.twin.servo_model import equivalent_actuator

FEW = (
    *("learning.episodes=20", "learning.episode_duration=1", "selection.every=10"),
    *("selection.round_trials=2", "selection.rounds=1", "selection.duration=0.5"),
)
TIMES = {"train_s", "decision_s"}


@pytest.fixture(scope="module", autouse=True)
def few():
    """The short form takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "QUICK_SETTINGS", FEW)
        patch.setattr(study, "QUICK", SearchSize(generations=1, tables=4, trials=1))
        yield


def small(given=(), **options):
    chosen = {"rows": ("sarsa", "best-table", "lqr", "random"), "worlds": ("ideal", "model")}
    short = {"quick": True, "trials": 3, "duration": 0.3, "seed": 4}
    return compare(given, **(chosen | short | options))


@pytest.fixture(scope="module")
def compared():
    return small()


def without_times(comparison):
    rows = comparison.model_dump()["rows"]
    return [{name: value for name, value in row.items() if name not in TIMES} for row in rows]


def test_rows_and_columns_are_those_that_were_asked_for(compared):
    found, tables = compared
    assert [row.name for row in found.rows] == ["sarsa", "best-table", "lqr", "random"]
    assert [row.kind for row in found.rows] == ["trained", "searched", "built in", "built in"]
    assert [column.name for column in found.columns] == ["ideal", "model"]
    assert set(tables) == {"sarsa", "best-table"}
    assert tables["sarsa"].settings.learning.learner == "sarsa"
    assert all(len(cell.results.survival) == 3 for row in found.rows for cell in row.cells)


def test_the_trials_are_those_of_an_evaluation(compared):
    found, tables = compared
    for row, policy in ((found.rows[2], load_policy("lqr")), (found.rows[0], tables["sarsa"])):
        settings = policy.settings.model_copy(update={"evaluation": found.evaluation})
        for cell, world in zip(row.cells, ("ideal", "model"), strict=True):
            alone = evaluate(policy, settings, world=world, seed=4, with_baselines=False)
            assert cell.results.survival == alone.results.survival
            assert cell.results.outcomes == alone.results.outcomes
            assert 0.0 < cell.rms_x < 0.22


def test_results_depend_on_the_seed_and_not_on_workers(compared):
    found = compared.comparison
    assert without_times(small(workers=3).comparison) == without_times(found)
    assert without_times(small(seed=5).comparison) != without_times(found)


def test_every_learner_has_the_same_budget_and_the_settings_of_its_recipe():
    for row in TRAINED:
        settings = settings_of(row)
        assert settings.learning.episodes == 10_000
        own = settings.model_copy(update={"learning": settings_of("robust").learning})
        if row in ("sarsa", "watkins", "double_q"):
            assert own == settings_of("robust")
            assert settings.learning.learner == row
    assert settings_of("paper", episodes=7).learning.episodes == 7


def test_costs_are_those_of_the_training(compared):
    found, tables = compared
    sarsa, searched, lqr, random = found.rows
    table = tables["sarsa"]
    assert (sarsa.episodes, sarsa.steps) == (20, table.steps)
    race = sum(c.trials * c.mean_duration for c in table.checkpoints) / table.h
    assert sarsa.selection_steps == pytest.approx(race)
    assert (sarsa.size, lqr.size, random.size) == (270, 32, 0)
    assert searched.episodes == 4
    assert sarsa.train_s > 0.0
    assert lqr.train_s is lqr.steps is None
    assert all(row.decision_s > 0.0 for row in found.rows)


def test_a_network_has_the_size_of_its_file_and_python_none(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    from tests.reference.onnx_network import linear_network

    path = tmp_path / "network.onnx"
    path.write_bytes(linear_network([[1.2], [1.8], [24.0], [3.0]]))
    assert size_of(load_policy(path)) == path.stat().st_size
    (tmp_path / "of_mine.py").write_text("def still(observation):\n    return 0.0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert size_of(load_policy("of_mine:still")) is None
    found = small(["network.onnx", "of_mine:still"], rows=(), worlds=("model",)).comparison
    assert [row.name for row in found.rows] == ["network.onnx", "of_mine:still"]
    assert {row.kind for row in found.rows} == {"given"}


def test_the_same_law_gives_the_same_trials_in_any_form(tmp_path, monkeypatch):
    gains = load_policy("lqr").kernel.gains
    law = f"import numpy\n\n\ndef law(seen):\n    return float(numpy.dot({gains}, seen))\n"
    (tmp_path / "as_python.py").write_text(law)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    found = small(["as_python:law"], rows=("lqr",)).comparison
    lqr, own = found.rows
    for mine, theirs in zip(own.cells, lqr.cells, strict=True):
        assert mine.results.survival == theirs.results.survival
        assert mine.rms_x == pytest.approx(theirs.rms_x, rel=1e-6)


@pytest.mark.compiled_only
def test_told_adds_a_column_in_which_controllers_know_the_twin():
    rows, worlds = ("paper", "lqr"), ("model", "twin:harsh")
    found = small(rows=rows, worlds=worlds, told=True, duration=0.1).comparison
    names = ["model", "twin:harsh", "twin:harsh, told"]
    assert [column.name for column in found.columns] == names
    own, knows = shipped_actuator(), equivalent_actuator(read_world("twin:harsh").settings)
    paper, lqr = found.rows
    known = [cell.actuators for cell in lqr.cells]
    assert known == [(own.digest,), (own.digest,), (knows.digest,)]
    # The paper's controller assumes an ideal arm everywhere: it has no model to tell.
    assert {cell.actuators for cell in paper.cells} == {(IDEAL_ACTUATOR.digest,)}
    assert trials_of((), rows, worlds, True, 3, True) == 2 * 3 * 3


def test_it_is_a_file(compared, tmp_path):
    compared.comparison.save(tmp_path / "compare.json", command="test")
    assert Comparison.load(tmp_path / "compare.json") == compared.comparison


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(InputError, match="there is no row 'dqn'; choose from paper, robust"):
        small(rows=("dqn",))
    with pytest.raises(InputError, match="0 policies are to be compared"):
        small(rows=())
    with pytest.raises(InputError, match="0 worlds are given"):
        small(worlds=())
    with pytest.raises(SettingsError, match="there is no world 'mars'"):
        small(worlds=("mars",))


def test_a_table_for_another_arm_is_refused(tmp_path, small_policy):
    path = tmp_path / "policy.json"
    small_policy.save(path, command="test")
    with pytest.raises(InputError, match="another pendulum or arm"):
        small([path], rows=())


@pytest.mark.slow
def test_the_baselines_and_the_best_table_bracket_the_learned_one():
    """The full form on the plants: 10,000 episodes, 200 trials of a minute."""
    rows = ("robust", "best-table", "lqr", "lqr-snapped", "pd", "random")
    found = compare(rows=rows, worlds=("ideal", "model")).comparison
    learned, best, lqr, snapped, pd, random = (
        [cell.results.summary().survived for cell in row.cells] for row in found.rows
    )
    assert best[1] >= learned[1] >= 0.97 * found.trials
    assert snapped[1] >= learned[1]
    assert lqr == [found.trials] * 2
    assert max(*pd, *random) == 0
