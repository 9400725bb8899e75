"""The claim of the project: a trained table stands a minute, for every seed."""

import pytest
from scipy.stats import binomtest

from equipoise.evaluation import evaluate
from equipoise.identification import identify
from equipoise.learning.trials import available_cores
from equipoise.model.arms.iiwa import iiwa
from equipoise.settings import resolve
from equipoise.training import train
from equipoise.trajectory import read_swing

TESTS = resolve(overrides=["evaluation.trials=1000"])


def summaries(pendulum, settings, seeds, tests=TESTS):
    """Train each seed alone, and return what the trials of each policy came to."""
    workers = available_cores()
    for seed in seeds:
        policy = train(pendulum, iiwa(7), settings, seed=seed, workers=workers)
        evaluation = evaluate(policy, tests, seed=seed, with_yardsticks=False, workers=workers)
        yield evaluation.results.summary()


def assert_they_stand(results):
    survived, trials = sum(r.survived for r in results), sum(r.trials for r in results)
    low = binomtest(survived, trials).proportion_ci(0.95, method="exact").low
    assert low >= 0.99
    assert sum(r.rate >= 0.985 for r in results) >= 0.9 * len(results)


@pytest.mark.compiled_only
def test_a_short_training_stands_most_of_the_time(pendulum):
    settings = resolve(overrides=["learning.episodes=3000", "selection.final_trials=60"])
    tests = resolve(overrides=["evaluation.trials=100", "evaluation.duration=20"])
    # The seed is fixed, so the result is too: 100 of 100; five other seeds stood in 93 to 100.
    (result,) = summaries(pendulum, settings, [0], tests)
    assert result.rate >= 0.9


@pytest.mark.slow
@pytest.mark.compiled_only
def test_every_seed_stands_a_minute(pendulum):
    assert_they_stand(list(summaries(pendulum, resolve(), range(10))))


@pytest.mark.slow
@pytest.mark.compiled_only
def test_every_seed_stands_a_minute_with_a_recorded_pendulum(recordings):
    pendulum = identify(read_swing(recordings / "free_swing_arm_55s.csv"))
    assert_they_stand(list(summaries(pendulum, resolve(), range(10))))
