"""Selection among candidates on common trials, and the test of a policy in held-out trials."""

import numpy as np
import pytest
from scipy.stats import binomtest

from equipoise import iiwa, paper, shipped_actuator
from equipoise.control.policy import TABLE, KernelPolicy, PolicyKernel, shipped_policy
from equipoise.learning.train import measure_survival, score_tables
from equipoise.model.grid import make_grid
from equipoise.model.random import SELECTION, TARGET_TEST
from equipoise.settings import changed, resolve
from equipoise.simulation import Setup
from equipoise.simulation.ideal import PlantSimulation


@pytest.fixture
def setup(pendulum):
    settings = resolve(overrides=["selection.duration=3", "selection.trials=24"])
    return Setup(pendulum, iiwa(7), settings, shipped_actuator(), paper.STEP)


def candidates(count, good):
    """Random tables, with a policy that balances among them."""
    rng = np.random.default_rng(0)
    tables = [rng.choice(paper.ACTIONS, 270) for _ in range(count)]
    tables[good] = shipped_policy().u_of_box
    return [(20 * i, table) for i, table in enumerate(tables)]


def test_the_policy_that_balances_scores_best_and_workers_change_nothing(setup):
    field = candidates(12, good=2)
    results = score_tables(setup, field, seed=3)
    assert [result.episodes for result in results] == [episodes for episodes, _ in field]
    assert max(range(12), key=lambda i: results[i].score) == 2
    assert results == score_tables(setup, field, seed=3, workers=3)


def test_a_result_is_that_of_the_policy_alone_on_the_common_trials(setup):
    field = candidates(3, good=1)
    for (_, table), result in zip(field, score_tables(setup, field, seed=3), strict=True):
        simulation = PlantSimulation("model", setup, seed=3, stream=SELECTION)
        trials = simulation.draw(24)
        boxes = make_grid(setup.settings.boxes, setup.pendulum.parameters().k)
        kernel = PolicyKernel(TABLE, table, boxes=boxes)
        simulation.run(KernelPolicy(kernel), trials, duration=3.0)
        assert (result.trials, result.survived) == (24, np.sum(trials.cause == 0))
        assert result.mean_duration == pytest.approx(0.01 * np.mean(trials.steps), rel=1e-12)
        rms_x = np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps))
        assert result.rms_x == pytest.approx(rms_x, rel=1e-12)
        score = result.mean_duration / 3.0 - 0.2 * rms_x / 0.22
        assert result.score == pytest.approx(score, rel=1e-12)


def policy_with(policy, trials):
    rule = {"selection.test_trials": trials, "selection.duration": 2.0}
    settings = changed(policy.settings, rule)
    return policy.model_copy(update={"settings": settings})


def test_the_bound_of_a_test_is_the_exact_one(monkeypatch):
    def fall(self, policy, duration, trials):
        trials.cause[:] = np.isin(trials.number, [5, 60, 100])
        return trials

    monkeypatch.setattr(PlantSimulation, "run_piece", fall)
    test = measure_survival(policy_with(shipped_policy(), 200), target=0.97, confidence=0.99)
    found = binomtest(197, 200, alternative="greater").proportion_ci(0.99, method="exact")
    assert (test.trials, test.survived) == (200, 197)
    assert test.at_least == pytest.approx(found.low, rel=1e-9)
    assert test.met is bool(found.low >= 0.97)


def test_the_test_uses_trials_of_its_own(monkeypatch):
    streams = []
    original = PlantSimulation.draw
    monkeypatch.setattr(
        PlantSimulation, "draw", lambda self, *n: streams.append(self.stream) or original(self, *n)
    )
    test = measure_survival(policy_with(shipped_policy(), 20), target=0.0)
    assert sum(test.causes.values()) == 20
    assert streams == [TARGET_TEST]
