"""Training: what its result depends on, how candidates are chosen, what the file says."""

import numpy as np
import pytest

from equipoise import Estimate, iiwa, resolve, shipped_actuator, shipped_policy
from equipoise.errors import InputError, SettingsError
from equipoise.learning import train as train_module
from equipoise.learning.episodes import learn
from equipoise.learning.train import check_task, measure_survival, train, train_to_target
from equipoise.simulation import Setup

ARM = iiwa(14)
QUICK = [
    *("learning.episodes=60", "learning.episode_duration=1", "selection.every=20"),
    *("selection.trials=20", "selection.duration=2", "selection.test_trials=100"),
]


def settings(*overrides, recipe="robust"):
    return resolve(recipe, overrides=[*QUICK, *overrides])


@pytest.fixture(scope="module")
def policies(pendulum):
    """Policies of three seeds, each trained alone on one thread."""
    return [train(pendulum, ARM, settings(), seed=5 + i) for i in range(3)]


def test_equal_seeds_give_equal_files_and_others_other_tables(pendulum, policies):
    assert train(pendulum, ARM, settings(), seed=5, workers=3).digest == policies[0].digest
    assert len({policy.Q for policy in policies}) == 3


# The target


@pytest.mark.parametrize(
    ("bounds", "chosen"), [((0.2, 0.5, 0.3), 1), ((0.7, 0.95, 0.99), 1), ((0.96,), 0)]
)
def test_the_first_policy_that_meets_the_target_or_the_best_one_is_the_result(
    monkeypatch, pendulum, policies, bounds, chosen
):
    def tested(policy, **_):
        bound = bounds[policy.seed - 5]  # no later policy is tested
        return shipped_policy().test.model_copy(update={"target": 0.9, "at_least": bound})

    monkeypatch.setattr(train_module, "train", lambda *_, seed, **__: policies[seed - 5])
    monkeypatch.setattr(train_module, "measure_survival", tested)
    found = train_to_target(pendulum, ARM, settings(), target=0.9, attempts=3, seed=5)
    assert found.seed == 5 + chosen
    assert found.Q == policies[chosen].Q
    assert ("misses the target" in found.shortfall) is (bounds[chosen] < 0.9)


def test_each_stage_of_each_attempt_is_shown_to_its_end(pendulum, policies):
    shown = {}

    def show(stage, fraction, text):
        shown.setdefault(stage, []).append(fraction)

    args = {"target": 0.9, "attempts": 2, "seed": 5, "workers": 2, "show": show}
    found = train_to_target(pendulum, ARM, settings(), **args)
    assert set(shown) == {f"{name}{n}" for name in ("train", "select", "test") for n in ("", " 2")}
    for fractions in shown.values():
        assert fractions == sorted(fractions)
        assert fractions[-1] == 1.0
    alone = policies[found.seed - 5]
    assert found.model_copy(update={"test": None}).digest == alone.digest
    assert found.test == measure_survival(alone, target=0.9, confidence=1.0 - 0.05 / 2)


def test_a_target_that_the_test_cannot_show_is_refused(pendulum):
    # An error of 0.05 in five attempts: 0.99^459 < 0.01.
    short = settings("selection.test_trials=458")
    with pytest.raises(InputError, match="458 trials cannot show"):
        train_to_target(pendulum, ARM, short, target=0.99, attempts=5)


# The selection


def test_the_candidate_with_the_best_score_is_the_policy(pendulum, policies):
    policy = policies[0]
    best, *others = policy.checkpoints
    assert len(others) == 1  # of the last 60 %: after 40 and 60 episodes
    assert best.score >= others[0].score
    # The table of the policy is the running average when that candidate was taken.
    setup = Setup(pendulum, ARM, settings(), shipped_actuator(), 0.01)
    average, selection = np.zeros((270, 8)), setup.settings.selection
    for taken, (point, tables) in enumerate(learn(setup, "model", 5, selection.every), 1):
        average += max(selection.averaging, 1.0 / taken) * (tables.Q - average)
        if point.episodes == best.episodes:
            break
    np.testing.assert_allclose(policy.table, average, rtol=0.0, atol=1e-12)


def test_without_candidates_the_last_table_is_kept(pendulum):
    policy = train(pendulum, ARM, settings("selection.every=0", recipe="paper"))
    assert policy.recipe.startswith("custom: paper with learning.episodes = 60, ")
    assert policy.checkpoints == ()


# What is kept


def test_the_learning_curve_counts_all_steps(policies):
    policy = policies[0]
    points = policy.learning_curve
    episodes, steps = [point.episodes for point in points], [point.steps for point in points]
    assert episodes == sorted(set(episodes))
    assert episodes[-1] == policy.episodes == 60
    assert steps == sorted(set(steps))
    assert steps[-1] == policy.steps
    # Mean durations times episodes are the steps of the episodes that ended: all, in the end.
    ended = np.cumsum(np.diff([0, *episodes]) * [point.duration for point in points] / 0.01)
    assert ended[-1] == pytest.approx(steps[-1], rel=1e-12)
    assert np.all(ended <= np.array(steps) * (1.0 + 1e-12))


# The physical limit


def test_a_pendulum_that_no_controller_balances_is_refused_before_the_training(pendulum):
    late = shipped_actuator().model_copy(update={"delay": Estimate.around(0.25, 0.0, "assumed")})
    with pytest.raises(SettingsError, match="no controller"):
        train(pendulum, ARM, settings(), actuator=late)
    assert check_task(pendulum, settings()) is None
    rough = settings("selection.test_trials=2000", "evaluation.phi_high=0.19")
    assert "% of the releases" in check_task(pendulum, rough)
    with pytest.raises(SettingsError, match="% of the releases"):
        train_to_target(pendulum, ARM, rough, target=0.99)


# A limited speed


def test_a_limited_speed_selects_among_the_tables_of_the_same_training(pendulum):
    # From upright on: no controller saves the other releases at this speed.
    gentle = ("evaluation.phi_low=0", "evaluation.phi_dot_low=0")
    limited = train(pendulum, ARM, settings("plant.max_speed=0.02", *gentle), seed=5)
    free = train(pendulum, ARM, settings(*gentle), seed=5)
    assert [p.duration for p in limited.learning_curve] == [p.duration for p in free.learning_curve]
    assert limited.steps == free.steps
    assert free.checkpoints[0].mean_duration > limited.checkpoints[0].mean_duration
    assert limited.checkpoints[0].survived == 0
    assert limited.settings.plant.max_speed == 0.02
