"""Training: what its result depends on, how candidates are chosen, what the file says."""

from collections import Counter

import numpy as np
import pytest

from equipoise.artefacts import Estimate
from equipoise.control.policy import shipped_policy
from equipoise.errors import InputError, SettingsError
from equipoise.learning import target as target_module
from equipoise.learning.choice import compile_learner
from equipoise.learning.episodes import (
    new_training_loop,
    new_training_state,
    train_episodes,
)
from equipoise.learning.target import measure_policy, train_to_target
from equipoise.learning.train import check_task, train, training_config
from equipoise.model.actuator import Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.random import SELECTION, TARGET_TEST, TEST
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.settings import resolve
from equipoise.worlds import interface, setup_of, simulate
from equipoise.worlds.plant import make_loop_params

# Thousands of episodes' worth of steps: minutes without compilation.
pytestmark = pytest.mark.compiled_only

ARM = iiwa(14)
QUICK = [
    "learning.episodes=60",
    "learning.episode_duration=1",
    "selection.every=20",
    "selection.rounds=3",
    "selection.round_trials=100",
    "selection.duration=2",
    "selection.test_trials=100",
]
KST = Actuator.assumed("kst", delay=0.0125, lag=0.008)
SLOW = Actuator.assumed("kst", delay=0.01, lag=0.004, cycle=0.016)


def settings(*overrides, recipe="robust"):
    return resolve(recipe, overrides=[*QUICK, *overrides])


def of_paper(*overrides):
    return settings("selection.every=0", *overrides, recipe="paper")


@pytest.fixture(scope="module")
def learners(pendulum):
    """Three learners of one seed, each trained alone on one thread."""
    return [train(pendulum, ARM, settings(), seed=5, learner=i) for i in range(3)]


def test_equal_seeds_give_equal_files_and_others_other_tables(pendulum, learners):
    assert train(pendulum, ARM, settings(), seed=5, workers=3).digest == learners[0].digest
    policies = [*learners, train(pendulum, ARM, settings(), seed=6)]
    assert len({policy.Q for policy in policies}) == 4


# The target


@pytest.mark.parametrize(
    ("verdicts", "chosen"),
    [
        ([(False, 0.2), (False, 0.5), (False, 0.3)], 1),
        ([(False, 0.7), (True, 0.6)], 1),
        ([(True, 0.6)], 0),
    ],
)
def test_the_first_learner_that_meets_the_target_or_the_best_one_is_the_result(
    monkeypatch, pendulum, learners, verdicts, chosen
):
    def tested(policy, **_):
        met, low = verdicts[policy.learner]  # no later learner is tested
        return shipped_policy().test.model_copy(update={"met": met, "interval": (low, 1.0)})

    monkeypatch.setattr(target_module, "train", lambda *_, learner, **__: learners[learner])
    monkeypatch.setattr(target_module, "measure_policy", tested)
    found = train_to_target(pendulum, ARM, settings(), target=0.9, learners=3, seed=5)
    assert found.learner == chosen
    assert found.Q == learners[chosen].Q
    assert ("misses the target" in found.shortfall) is not verdicts[chosen][0]


def test_each_stage_of_each_learner_is_shown_to_its_end(pendulum, learners):
    shown = {}

    def show(stage, share, text):
        shown.setdefault(stage, []).append(share)

    given = {"target": 0.9, "learners": 2, "seed": 5, "workers": 2, "show": show}
    found = train_to_target(pendulum, ARM, settings(), **given)
    assert set(shown) == {f"{name}{n}" for name in ("train", "select", "test") for n in ("", " 2")}
    for shares in shown.values():
        assert shares == sorted(shares)
        assert shares[-1] == 1.0 > shares[0]
    alone = learners[found.learner]
    assert found.model_copy(update={"test": None}).digest == alone.digest
    assert found.test == measure_policy(alone, target=0.9, error=(0.025, 0.05 / 6)[found.learner])


def test_a_target_that_the_test_cannot_show_is_refused(pendulum):
    for target, learners in ((0.99, 6), (1.0, 6), (0.5, 0)):
        with pytest.raises(InputError):
            train_to_target(pendulum, ARM, settings(), target=target, learners=learners)


# The selection


def test_the_winner_of_the_race_is_the_policy(pendulum, learners):
    policy = learners[0]
    best = policy.checkpoints[0]
    assert len(policy.checkpoints) == 3
    assert best.trials == max(each.trials for each in policy.checkpoints)
    assert best.score == max(c.score for c in policy.checkpoints if c.trials == best.trials)
    # The table of the policy is the running average at the moment when the winner was taken.
    plant = make_loop_params(ARM, settings(), 0.01, pendulum.parameters(), shipped_actuator())
    constants = training_config(settings(), pendulum.parameters().k)
    learner = compile_learner(settings().learning)
    progress, averaged = new_training_state(270), np.zeros((270, 8))
    selection, key = settings().selection, np.array((5, 0))
    loop = new_training_loop(plant, pendulum.parameters(), constants, learner, progress, key)
    for taken in range(1, best.episodes // selection.every + 1):
        until = taken * selection.every
        train_episodes(loop, until)
        averaged += max(selection.averaging, 1.0 / taken) * (progress.tables.Q - averaged)
    np.testing.assert_allclose(policy.table, averaged, rtol=0.0, atol=1e-12)


def test_only_the_latest_candidates_race(pendulum):
    late = train(pendulum, ARM, settings("selection.late=0.5"), seed=5)
    assert {each.episodes // 20 for each in late.checkpoints} == {2, 3}
    last = train(pendulum, ARM, settings("selection.candidates=1"), seed=5)
    assert [each.episodes for each in last.checkpoints] == [60]


def test_race_and_test_have_trials_of_their_own(monkeypatch, pendulum):
    seen = set()
    original = interface.draw_trials

    def spy(count, settings, seed, stream, spread, first):
        seen.add((seed, stream, spread))
        return original(count, settings, seed, stream, spread, first)

    monkeypatch.setattr(interface, "draw_trials", spy)
    train_to_target(pendulum, ARM, settings(), target=0.9, learners=2, seed=5)
    assert seen == {(5, SELECTION, settings().selection.spread), (5, TARGET_TEST, 1.0)}
    assert TEST not in (SELECTION, TARGET_TEST)


def test_the_test_of_a_policy_is_its_evaluation_with_other_seeds(pendulum, learners):
    policy = learners[0]
    test = measure_policy(policy, target=0.0)
    setup = setup_of(policy, "model")
    simulation = simulate("model", setup, seed=policy.seed, stream=TARGET_TEST)
    trials = simulation.draw(test.trials)
    simulation.run(policy, trials, range(test.trials), duration=2.0)
    causes = Counter(TRIAL_OUTCOMES[code] for code in trials.cause.tolist())
    assert test.causes == causes
    assert test.survived == causes["lasted"]


def test_without_candidates_the_last_table_is_kept(pendulum):
    policy = train(pendulum, ARM, of_paper())
    assert policy.recipe.startswith("custom: paper with learning.episodes = 60, ")
    assert policy.checkpoints == ()


# What is kept


def test_the_learning_curve_counts_all_steps(learners):
    policy = learners[0]
    points = policy.learning_curve
    episodes, steps = [each.episodes for each in points], [each.steps for each in points]
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
