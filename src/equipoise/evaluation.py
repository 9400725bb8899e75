"""Evaluate: how long a policy stands, with what confidence, and why it falls.

Trials start as a release leaves the pendulum and run on plants that vary around the pendulum the
policy was trained for. Test seeds are used nowhere else. The yardsticks run the same trials.
"""

from collections import Counter
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.stats import binomtest

from equipoise import paper
from equipoise.artefacts import Artefact, Value
from equipoise.control.policy import Policy, PolicyKernel, TabularPolicy
from equipoise.control.yardsticks import yardsticks
from equipoise.learning.closed_loop import CAUSES, Plant, Trials, make_plant, record_trial, scaled
from equipoise.learning.trials import draw_trials, run_over_cores
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import TEST
from equipoise.settings import Settings

CONFIDENCE = 0.95

Done = Callable[[int], None]
"""Called with the number of trials that have just finished."""


class Summary(NamedTuple):
    """What the trials of one policy come to; derived, never stored."""

    trials: int
    survived: int
    rate: float
    """Share of the trials that lasted."""
    interval: tuple[float, float]
    """Exact (Clopper-Pearson) 95 % interval of the probability to last."""
    median: float
    """Median survival [s]."""
    quantiles: tuple[float, float, float, float]
    """Survival at 5, 25, 75 and 95 % of the trials [s]."""
    causes: dict[str, int]
    """How many trials ended in which way."""


class TrialResults(Value):
    """The trials of one policy, in their order."""

    name: str
    """Whose trials these are."""
    survival: tuple[float, ...]
    """How long each trial lasted [s]."""
    causes: tuple[str, ...]
    """How each ended: lasted, angle, track, joint limit."""

    def summary(self) -> Summary:
        """Return share, interval, quantiles and causes."""
        trials, survived = len(self.survival), self.causes.count(CAUSES[0])
        interval = binomtest(survived, trials).proportion_ci(CONFIDENCE, method="exact")
        q05, q25, q50, q75, q95 = np.quantile(self.survival, [0.05, 0.25, 0.5, 0.75, 0.95])
        return Summary(
            trials=trials,
            survived=survived,
            rate=survived / trials,
            interval=(float(interval.low), float(interval.high)),
            median=float(q50),
            quantiles=(float(q05), float(q25), float(q75), float(q95)),
            causes=dict(Counter(self.causes)),
        )


class Evaluation(Artefact):
    """All trials of a policy and of the yardsticks beside it."""

    FORMAT: ClassVar[str] = "equipoise-evaluation"
    VERSION: ClassVar[int] = 1

    policy: str
    """Digest of the policy, or the name of the function that was evaluated."""
    world: str
    """Where the trials ran."""
    arm: str
    """Name of the arm."""
    arm_digest: str
    """Digest of the arm."""
    pendulum: str
    """Digest of the pendulum that the trials vary."""
    settings: Settings
    """Resolved settings: starts, noise, number and length of the trials."""
    seed: int
    """Master seed; with a trial's number it decides its conditions and its noise."""
    results: TrialResults
    """Trials of the policy."""
    yardsticks: tuple[TrialResults, ...]
    """Trials of the yardsticks, on the same conditions."""

    @property
    def duration(self) -> float:
        """Length of a trial [s]."""
        return self.settings.evaluation.duration


def evaluate(
    policy: TabularPolicy,
    settings: Settings | None = None,
    *,
    seed: int = 0,
    with_yardsticks: bool = True,
    workers: int = 1,
    done: Done = lambda _: None,
) -> Evaluation:
    """Evaluate a trained policy on the plant that it was trained for.

    Args:
        policy: The policy.
        settings: Number, length and starts of the trials, noise of the plant; the policy's own
            settings if not given.
        seed: Master seed of the trials.
        with_yardsticks: Run the yardsticks on the same trials.
        workers: Number of threads; the result does not depend on it.
        done: Called with the number of trials that have just finished.
    """
    settings = policy.settings if settings is None else settings
    plant = make_plant(policy.arm, settings, policy.h)
    pendulum = policy.pendulum.parameters()._replace(linearised=settings.plant.linearised)

    def run(name: str, kernel: PolicyKernel) -> TrialResults:
        trials = _conditions(settings, seed)
        run_over_cores(
            plant,
            kernel,
            pendulum,
            trials,
            duration=settings.evaluation.duration,
            seed=seed,
            stream=TEST,
            workers=workers,
            done=done,
        )
        return _results(name, plant, trials)

    results = run("policy", policy.kernel)
    beside = yardsticks(pendulum, plant.h) if with_yardsticks else {}
    return Evaluation(
        policy=policy.digest,
        world="model",
        arm=policy.arm.name,
        arm_digest=policy.arm.digest,
        pendulum=policy.pendulum.digest,
        settings=settings,
        seed=seed,
        results=results,
        yardsticks=tuple(run(name, kernel) for name, kernel in beside.items()),
    )


def evaluate_function(
    policy: Policy,
    name: str,
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    seed: int = 0,
    done: Done = lambda _: None,
) -> Evaluation:
    """Evaluate any object with `act(state) -> u`, on the same trials as a table.

    The policy runs in Python, so this takes a second per trial or so.

    Args:
        policy: What decides.
        name: What to call it.
        pendulum: The pendulum that the trials vary.
        arm: The arm.
        settings: Number, length and starts of the trials, noise of the plant.
        seed: Master seed of the trials.
        done: Called with the number of trials that have just finished.
    """
    plant = make_plant(arm, settings, paper.STEP)
    parameters = pendulum.parameters()._replace(linearised=settings.plant.linearised)
    trials = _conditions(settings, seed)
    longest = round(settings.evaluation.duration / plant.h)
    for i in range(len(trials.steps)):
        own: PendulumParameters = scaled(
            parameters, float(trials.inertia_factor[i]), float(trials.friction_factor[i])
        )
        trials.cause[i], rows = record_trial(
            plant, policy, own, trials.start[i], longest, seed, TEST, i
        )
        trials.steps[i] = len(rows.u)
        done(1)
    return Evaluation(
        policy=name,
        world="model",
        arm=arm.name,
        arm_digest=arm.digest,
        pendulum=pendulum.digest,
        settings=settings,
        seed=seed,
        results=_results(name, plant, trials),
        yardsticks=(),
    )


def _conditions(settings: Settings, seed: int) -> Trials:
    return draw_trials(settings.evaluation.trials, settings, seed, TEST, spread=1.0)


def _results(name: str, plant: Plant, trials: Trials) -> TrialResults:
    return TrialResults(
        name=name,
        survival=tuple(round(steps * plant.h, 6) for steps in trials.steps.tolist()),
        causes=tuple(CAUSES[cause] for cause in trials.cause.tolist()),
    )
