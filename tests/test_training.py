"""Training: what its result depends on, how candidates are chosen, what the file says."""

import numpy as np
import pytest

from equipoise import training
from equipoise.artefacts import Estimate
from equipoise.control.policy import TabularPolicy
from equipoise.errors import SettingsError
from equipoise.learning.choice import compile_learner
from equipoise.learning.closed_loop import make_loop_params
from equipoise.learning.episodes import new_training_state, train_episodes
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.random import FINAL_ROUND, SCREENING, TEST
from equipoise.settings import resolve
from equipoise.simulation import plant
from equipoise.training import check_task, train, train_several

# Thousands of episodes' worth of steps: minutes without compilation.
pytestmark = pytest.mark.compiled_only

ARM = iiwa(14)
QUICK = [
    "learning.episodes=60",
    "learning.episode_duration=1",
    "selection.every=20",
    "selection.screening_trials=70",  # more than one piece of 64 trials
    "selection.final_trials=70",
    "selection.finalists=2",
    "selection.duration=2",
    "selection.final_duration=3",
]


def settings(*overrides, recipe="robust"):
    return resolve(recipe, overrides=[*QUICK, *overrides])


def of_paper(*overrides):
    return settings("selection.every=0", *overrides, recipe="paper")


@pytest.fixture(scope="module")
def learners(pendulum):
    """Three learners of one seed, each trained alone on one thread."""
    return [train(pendulum, ARM, settings(), seed=5, learner=i) for i in range(3)]


# What the result depends on


def test_equal_seeds_give_equal_files(pendulum, learners):
    assert train(pendulum, ARM, settings(), seed=5).digest == learners[0].digest


def test_workers_do_not_change_a_bit(pendulum, learners):
    assert train(pendulum, ARM, settings(), seed=5, workers=2).digest == learners[0].digest


def test_other_seeds_and_learners_give_other_tables(pendulum, learners):
    policies = [*learners, train(pendulum, ARM, settings(), seed=6)]
    assert len({policy.Q for policy in policies}) == 4


@pytest.mark.parametrize("workers", [1, 2])
def test_several_learners_are_those_trained_one_by_one(pendulum, learners, workers):
    together = train_several(pendulum, ARM, settings(), learners=3, seed=5, workers=workers)
    assert {policy.learner for policy in together} == {0, 1, 2}
    for policy in together:
        assert policy.digest == learners[policy.learner].digest


def test_the_best_of_several_comes_first(pendulum):
    together = train_several(pendulum, ARM, settings(), learners=3, seed=5)
    scores = [policy.checkpoints[0].score for policy in together]
    assert scores == sorted(scores, reverse=True)
    assert len(set(scores)) > 1


def test_several_without_a_selection_keep_their_order(pendulum):
    together = train_several(pendulum, ARM, of_paper(), learners=3, workers=2)
    assert [policy.learner for policy in together] == [0, 1, 2]


def test_one_learner_is_one_training(pendulum, learners):
    (only,) = train_several(pendulum, ARM, settings(), learners=1, seed=5, workers=2)
    assert only.digest == learners[0].digest


def test_a_selection_does_not_disturb_the_training(pendulum):
    # The same episodes, whether they are interrupted for candidates or not.
    with_candidates = train(pendulum, ARM, settings(), seed=5)
    without = train(pendulum, ARM, settings("selection.every=0"), seed=5)
    assert with_candidates.steps == without.steps
    assert [p.duration for p in with_candidates.learning_curve][-1] > 0.0


# Behind an actuator

KST = Actuator.assumed("kst", delay=0.0125, lag=0.008)


@pytest.fixture(scope="module")
def behind(pendulum):
    """Two learners of one seed behind an actuator, each trained alone on one thread."""
    overrides = settings("learning.episodes=120")
    return [train(pendulum, ARM, overrides, actuator=KST, seed=5, learner=i) for i in range(2)]


def test_behind_an_actuator_equal_seeds_give_equal_files(pendulum, behind):
    again = train(pendulum, ARM, settings("learning.episodes=120"), actuator=KST, seed=5, workers=2)
    assert again.digest == behind[0].digest
    assert again.episodes == 120


@pytest.mark.parametrize("workers", [1, 2])
def test_several_learners_behind_an_actuator_are_those_trained_one_by_one(
    pendulum, behind, workers
):
    together = train_several(
        pendulum,
        ARM,
        settings("learning.episodes=120"),
        learners=2,
        actuator=KST,
        seed=5,
        workers=workers,
    )
    assert {policy.digest for policy in together} == {policy.digest for policy in behind}


def test_a_policy_behind_an_actuator_can_be_trained_again_from_its_own_file(
    pendulum, behind, tmp_path
):
    behind[1].save(tmp_path / "policy.json", command="test")
    read = TabularPolicy.load(tmp_path / "policy.json")
    assert read.actuator == KST
    again = train(
        read.pendulum,
        read.arm,
        read.settings,
        actuator=read.actuator,
        seed=read.seed,
        learner=read.learner,
    )
    assert again.digest == behind[1].digest


@pytest.mark.parametrize(
    "overrides",
    [
        ["controller.predict=false"],
        ["controller.margin=0.01"],
        ["controller.acceleration_sigma=1"],
        ["plant.delay_spread=0"],
        ["plant.lag_spread=0"],
        ["plant.zero_error=0"],
        ["plant.counts_per_rev=4096"],
    ],
    ids=str,
)
def test_controller_and_rig_are_part_of_the_training(pendulum, behind, overrides):
    other = settings("learning.episodes=120", "selection.every=0", *overrides)
    plain = settings("learning.episodes=120", "selection.every=0")
    assert (
        train(pendulum, ARM, other, actuator=KST, seed=5).Q
        != train(pendulum, ARM, plain, actuator=KST, seed=5).Q
    )
    # ... and of no effect where the actuator is ideal.
    few = ["learning.episodes=20", "selection.every=0", "plant.ideal=true"]
    alike = [train(pendulum, ARM, settings(*few, *extra)).Q for extra in (overrides, [])]
    assert alike[0] == alike[1]


def test_without_an_actuator_it_is_the_shipped_one_or_by_the_settings_none(pendulum):
    few = ["learning.episodes=20", "selection.every=0"]
    shipped = train(pendulum, ARM, settings(*few))
    assert shipped.actuator == shipped_actuator()
    assert shipped == train(pendulum, ARM, settings(*few), actuator=shipped_actuator())
    ideal = train(pendulum, ARM, settings(*few, "plant.ideal=true"))
    assert ideal.actuator == IDEAL_ACTUATOR
    assert ideal.Q == train(pendulum, ARM, settings(*few), actuator=IDEAL_ACTUATOR).Q
    # The paper's recipe is the paper's simulation.
    assert train(pendulum, ARM, of_paper()).actuator == IDEAL_ACTUATOR


def test_other_actuators_make_other_policies(pendulum, behind):
    plain = settings("learning.episodes=120", "selection.every=0")
    tables = {
        train(pendulum, ARM, plain, actuator=actuator, seed=5).Q
        for actuator in (IDEAL_ACTUATOR, KST, Actuator.assumed("lag", delay=0.0125, lag=0.02))
    }
    assert len(tables) == 3


# The selection


def test_candidates_are_sorted_by_their_score_and_the_first_is_the_policy(pendulum):
    policy = train(pendulum, ARM, settings("selection.finalists=3"), seed=5)
    scores = [candidate.score for candidate in policy.checkpoints]
    assert len(scores) == 3
    assert scores == sorted(scores, reverse=True)
    # The table of the policy is the running average at the moment when the winner was taken.
    plant = make_loop_params(ARM, settings(), 0.01, pendulum.parameters(), shipped_actuator())
    constants, learner = training.training_config(settings()), compile_learner(settings().learning)
    progress, averaged = new_training_state(), np.zeros((270, 8))
    selection = settings().selection
    for taken in range(1, policy.checkpoints[0].episodes // selection.every + 1):
        until = taken * selection.every
        train_episodes(plant, pendulum.parameters(), constants, learner, progress, until, 5, 0)
        averaged += max(selection.averaging, 1.0 / taken) * (progress.tables.Q - averaged)
    np.testing.assert_allclose(policy.table, averaged, rtol=0.0, atol=1e-12)
    assert policy.visits == tuple(map(tuple, progress.tables.visits.tolist()))


def test_a_candidate_is_judged_on_all_of_its_trials(pendulum):
    policy = train(pendulum, ARM, settings("selection.rms_x_weight=0.5"), seed=5)
    for candidate in policy.checkpoints:
        assert candidate.trials == 70
        assert 0 <= candidate.survived <= 70
        assert 0.0 < candidate.mean_duration <= 3.0
        assert 0.0 < candidate.rms_x < 0.22
        # mean duration / duration - weight rms(x) / 0.22 m, as the settings say.
        score = candidate.mean_duration / 3.0 - 0.5 * candidate.rms_x / 0.22
        assert candidate.score == pytest.approx(score, rel=1e-12)


def test_no_more_finalists_than_asked_for_and_no_more_than_candidates(pendulum):
    assert len(train(pendulum, ARM, settings("selection.finalists=1")).checkpoints) == 1
    assert len(train(pendulum, ARM, settings("selection.finalists=50")).checkpoints) == 3


def test_all_learners_are_compared_on_the_same_selection_trials(monkeypatch, pendulum):
    seen = []
    original = plant.draw_trials

    def spy(count, settings, seed, stream, spread, first):
        seen.append((count, seed, stream, spread))
        return original(count, settings, seed, stream, spread, first)

    monkeypatch.setattr(plant, "draw_trials", spy)
    train_several(pendulum, ARM, settings("selection.screening_trials=30"), learners=2, seed=5)
    # The final round has trials of its own, and neither has those of the test.
    assert set(seen) == {(30, 5, SCREENING, 2.0), (70, 5, FINAL_ROUND, 2.0)}
    assert TEST not in (SCREENING, FINAL_ROUND)


def test_the_recipe_paper_selects_nothing_and_keeps_the_last_table(pendulum):
    policy = train(pendulum, ARM, of_paper())
    assert policy.recipe.startswith("custom: paper with learning.episodes = 60, ")
    assert policy.checkpoints == ()
    progress = new_training_state()
    train_episodes(
        make_loop_params(ARM, of_paper(), 0.01, pendulum.parameters(linearised=True)),
        pendulum.parameters(linearised=True),
        training.training_config(of_paper()),
        compile_learner(of_paper().learning),
        progress,
        60,
        0,
        0,
    )
    assert np.array_equal(progress.tables.Q, policy.table)
    assert all(point.survival is None for point in policy.learning_curve)


# What is said and kept


def test_the_learning_curve_is_told_as_it_grows(pendulum):
    told = []
    policy = train(pendulum, ARM, settings(), seed=5, report=told.append)
    assert tuple(told) == policy.learning_curve
    episodes = [point.episodes for point in told]
    steps = [point.steps for point in told]
    assert episodes == sorted(set(episodes))
    assert episodes[-1] == policy.episodes == 60
    assert steps == sorted(set(steps))
    assert steps[-1] == policy.steps
    # Mean durations times episodes are the steps of the episodes that ended: all, in the end.
    ended = np.cumsum(np.diff([0, *episodes]) * [point.duration for point in told] / 0.01)
    assert ended[-1] == pytest.approx(steps[-1], rel=1e-12)
    assert np.all(ended <= np.array(steps) * (1.0 + 1e-12))
    assert all(0.0 <= point.survival <= 1.0 for point in told)


def test_several_learners_tell_whose_point_it_is(pendulum):
    told = []
    together = train_several(
        pendulum, ARM, settings(), learners=2, seed=5, report=lambda *point: told.append(point)
    )
    for policy in together:
        points = tuple(point for learner, point in told if learner == policy.learner)
        assert points == policy.learning_curve


def test_a_training_without_candidates_reports_its_progress_too(pendulum):
    told = []
    train(pendulum, ARM, of_paper("learning.episodes=400"), report=told.append)
    # MAX_REPORTS = 200 points at most: every second episode or later, where several end together.
    assert 50 < len(told) <= training.MAX_REPORTS


def test_a_policy_says_how_it_was_made(pendulum, learners, tmp_path):
    policy = learners[2]
    assert (policy.seed, policy.learner) == (5, 2)
    assert policy.settings == settings()
    assert policy.pendulum == pendulum
    assert policy.arm == ARM
    assert policy.actuator == shipped_actuator()
    assert policy.h == 0.01
    policy.save(tmp_path / "policy.json", command="test")
    assert TabularPolicy.load(tmp_path / "policy.json").digest == policy.digest


def test_a_policy_can_be_trained_again_from_its_own_file(pendulum, learners, tmp_path):
    learners[1].save(tmp_path / "policy.json", command="test")
    read = TabularPolicy.load(tmp_path / "policy.json")
    again = train(
        read.pendulum,
        read.arm,
        read.settings,
        seed=read.seed,
        learner=read.learner,
    )
    assert again.digest == read.digest


def test_settings_become_the_constants_of_the_learner():
    constants = training.training_config(
        resolve(
            overrides=[
                "learning.episodes=11",
                "learning.episode_duration=0.29",
                "learning.gamma=0.31",
                "learning.alpha_initial=0.32",
                "learning.alpha_decay=0.33",
                "learning.alpha_minimum=0.04",
                "learning.epsilon_initial=0.35",
                "learning.epsilon_until=0.36",
                "learning.reward_failure=-0.37",
                "learning.trace_decay=0.38",
                "learning.mirrored=false",
                "learning.hold_action=false",
                "learning.start_x=0.12",
                "learning.start_x_dot=0.13",
                "learning.start_phi=0.14",
                "learning.start_phi_dot=0.15",
                "plant.inertia_sigma=0.16",
                "plant.friction_sigma=0.17",
                "plant.delay_spread=0.018",
                "plant.lag_spread=0.19",
                "plant.zero_error=0.020",
            ]
        )
    )
    assert constants == (
        11,
        29,  # 0.29 / 0.01 is 28.999999999999996: rounded, not cut
        0.31,
        0.35,
        0.36,
        -0.37,
        False,
        (0.32, 0.33, 0.04, 0.38, False),
        (0.12, 0.13, 0.14, 0.15),
        0.16,
        0.17,
        0.018,
        0.19,
        0.020,
        constants.boxes,
        constants.actions,
    )


@pytest.mark.slow
def test_ten_thousand_robust_episodes_make_a_policy_that_stands(pendulum):
    policy = train(pendulum, ARM, resolve(), seed=1, workers=2)
    best = policy.checkpoints[0]
    # DESIGN: 60 s in the median on 8 of 8 seeds; chosen among candidates, nearly all trials last.
    assert best.survived >= 0.98 * best.trials


@pytest.mark.parametrize("actuator", [IDEAL_ACTUATOR, KST], ids=["ideal", "kst"])
def test_episodes_last_longer_as_the_training_goes_on(pendulum, actuator):
    longer = ["learning.episodes=600", "learning.episode_duration=10", "selection.every=0"]
    curve = train(pendulum, ARM, settings(*longer), actuator=actuator, seed=1).learning_curve
    durations, n = [point.duration for point in curve], len(curve)
    # Chance: on six seeds the second half was 2.8 to 14 times as long as the first sixth.
    assert np.mean(durations[n // 2 :]) > 1.8 * np.mean(durations[: n // 6])


# The physical limit


def test_a_pendulum_that_no_controller_balances_is_refused_before_the_training(pendulum):
    late = shipped_actuator().model_copy(update={"delay": Estimate.around(0.25, 0.0, "assumed")})
    begun = []
    with pytest.raises(SettingsError, match="no controller balances this pendulum"):
        train(pendulum, ARM, settings(), actuator=late, report=begun.append)
    assert begun == []
    assert check_task(pendulum, ARM, settings()) is None
    part = late.model_copy(update={"delay": Estimate.around(0.1, 0.0, "assumed")})
    assert "% of the releases" in check_task(pendulum, ARM, settings(), part)


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
