"""Policies of every kind run wherever a table runs, with results that name them by digest."""

import numpy as np
import pytest

from equipoise.control.bound_policy import load_policy
from equipoise.rig.simulate import simulate_run
from equipoise.settings import resolve
from equipoise.worlds.evaluation import evaluate
from tests.control.test_bound_policy import KINDS, folder

__all__ = ["folder"]

pytestmark = [pytest.mark.full, pytest.mark.compiled_only]
FEW = resolve(overrides=["evaluation.trials=2", "evaluation.duration=0.5"])


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_is_evaluated_and_deployed_repeatably(folder, name):
    policy = load_policy(name)
    for world in ("ideal", "model", "twin:nominal"):
        evaluation = evaluate(policy, FEW, world=world, with_baselines=False)
        assert (evaluation.policy, evaluation.results.name) == (policy.digest, policy.name)
        assert len(evaluation.results.survival) == 2
        again = evaluate(load_policy(name), FEW, world=world, with_baselines=False)
        assert again.digest == evaluation.digest
    runs = [simulate_run(load_policy(name), world="twin:nominal", duration=0.5) for _ in range(2)]
    assert runs[0].conditions.policy == policy.digest
    assert np.array_equal(runs[0].u, runs[1].u)


@pytest.mark.parametrize("world", ["ideal", "model", "twin:nominal"])
def test_lqr_as_a_function_gives_the_trials_of_the_built_in_lqr(folder, world):
    settings = resolve(overrides=["evaluation.trials=6", "evaluation.duration=5"])
    own = evaluate(load_policy("guest:lqr"), settings, world=world)
    built_in = evaluate(load_policy("lqr"), settings, world=world, with_baselines=False)
    beside = next(results for results in own.baselines if results.name == "LQR")
    for other in (built_in.results, beside):
        assert own.results.survival == other.survival
        assert own.results.outcomes == other.outcomes
    runs = [simulate_run(load_policy(n), world=world, duration=2.0) for n in ("guest:lqr", "lqr")]
    assert np.array_equal(runs[0].u, runs[1].u)
