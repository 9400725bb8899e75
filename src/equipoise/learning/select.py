"""Selection of a table among candidates, and the test of the selected policy.

All candidates run the same trials: common random numbers make differences between them larger than
those between trials. The best of many results is biased, so the test runs trials that selected
nothing, as `evaluate` does. Their number is fixed, so that the lower bound of the probability to
survive is exact (Clopper & Pearson 1934).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from equipoise import paper
from equipoise.arguments import Workers
from equipoise.arrays import Array
from equipoise.control.policy import Checkpoint, TabularPolicy, TargetTest, table_kernel
from equipoise.errors import InputError
from equipoise.executors import completed
from equipoise.model.grid import TRUNCATED, make_grid
from equipoise.model.random import SELECTION, TARGET_TEST
from equipoise.model.worlds import MODEL
from equipoise.settings import SelectionSettings
from equipoise.simulation import setup_of
from equipoise.simulation.evaluation import lower_bound, trial_results
from equipoise.simulation.ideal import PlantSimulation
from equipoise.simulation.interface import Setup

RMS_X_WEIGHT: Final = 0.2
"""Weight of rms(x) in the score = mean duration / duration - weight * rms(x) / 0.22 m. Trials end
at the track. Over 40 policies the rank correlation of rms(x) in 24 trials with the failures in 96
trials of five minutes was 0.85; that of the fraction survived was 0.81."""


def score_tables(
    setup: Setup,
    candidates: Sequence[tuple[int, Array]],
    *,
    seed: int,
    workers: Workers = 1,
    done: Callable[[float], None] = lambda _: None,
) -> list[Checkpoint]:
    """Score candidates on common trials.

    Args:
        setup: Pendulum, arm, settings and actuator.
        candidates: Number of training episodes of each, and its accelerations [m/s^2], shape
            (boxes,).
        seed: Master seed of the trials.
        workers: Number of threads, or an executor; the result does not depend on it.
        done: Called with the number of trials that have just finished.
    """
    simulation = PlantSimulation(MODEL, setup, seed=seed, stream=SELECTION)
    scored: dict[int, Checkpoint] = {}
    for i, checkpoint in completed(partial(_score_table, simulation), candidates, workers):
        scored[i] = checkpoint
        done(checkpoint.trials)
    return [scored[i] for i in range(len(candidates))]


def _score_table(simulation: PlantSimulation, candidate: tuple[int, Array]) -> Checkpoint:
    """Score a candidate: its number of training episodes, and its accelerations [m/s^2]."""
    (episodes, u_of_box), setup = candidate, simulation.setup
    rule, boxes = setup.settings.selection, make_grid(setup.settings.boxes, simulation.pendulum.k)
    trials = simulation.draw(rule.trials)
    rows = range(rule.trials)
    simulation.run(table_kernel(u_of_box, boxes), trials, rows, duration=rule.duration)
    mean_duration = float(np.mean(trials.steps)) * setup.h
    rms_x = float(np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps)))
    score = mean_duration / rule.duration - RMS_X_WEIGHT * rms_x / paper.X_LIMIT
    return Checkpoint(
        episodes=episodes,
        trials=rule.trials,
        survived=int(np.sum(trials.cause == TRUNCATED)),
        mean_duration=mean_duration,
        rms_x=rms_x,
        score=score,
    )


def measure_survival(
    policy: TabularPolicy,
    *,
    target: float,
    confidence: float = 0.95,
    workers: Workers = 1,
    done: Callable[[float], None] = lambda _: None,
) -> TargetTest:
    """Test a policy in held-out trials on the plant of its training.

    Args:
        policy: The policy; its settings give number and length of the trials.
        target: Required probability to survive a trial.
        confidence: Confidence of the lower bound.
        workers: Number of threads, or an executor; the result does not depend on it.
        done: Called with the number of trials that have just finished.
    """
    rule = policy.settings.selection
    simulation = PlantSimulation(
        MODEL, setup_of(policy, MODEL), seed=policy.seed, stream=TARGET_TEST
    )
    trials = simulation.draw(rule.test_trials)
    rows = range(rule.test_trials)
    simulation.run(policy, trials, rows, duration=rule.duration, workers=workers, done=done)
    found = trial_results(policy.name, trials, policy.h).summary()
    return TargetTest(
        target=target,
        duration=rule.duration,
        trials=rule.test_trials,
        survived=found.survived,
        at_least=lower_bound(found.survived, rule.test_trials, confidence),
        causes=found.outcomes,
    )


def check_target(target: float, rule: SelectionSettings, confidence: float) -> None:
    """Raise InputError if a test cannot show a target, even without a failure."""
    if lower_bound(rule.test_trials, rule.test_trials, confidence) < target:
        raise InputError(
            f"{rule.test_trials:,} trials cannot show a survival of {target:g}, even without a "
            "failure; lower --target, or raise selection.test_trials"
        )
