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
from equipoise.learning.closed_loop import CAUSES, make_plant, scaled
from equipoise.learning.trials import Trials, draw_trials, record_trial, run_over_cores
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
    bench = _Bench(policy.pendulum, policy.arm, settings, policy.h, seed, workers, done)
    return bench.evaluation(policy.digest, bench.run("policy", policy.kernel), with_yardsticks)


def evaluate_function(
    policy: Policy,
    name: str,
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    seed: int = 0,
    with_yardsticks: bool = True,
    workers: int = 1,
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
        with_yardsticks: Run the yardsticks on the same trials.
        workers: Number of threads for the yardsticks.
        done: Called with the number of trials that have just finished.
    """
    bench = _Bench(pendulum, arm, settings, paper.STEP, seed, workers, done)
    return bench.evaluation(name, bench.run_in_python(name, policy), with_yardsticks)


class _Bench:
    """The trials of one evaluation, on which any number of policies run."""

    def __init__(
        self,
        pendulum: Pendulum,
        arm: Arm,
        settings: Settings,
        h: float,
        seed: int,
        workers: int,
        done: Done,
    ) -> None:
        self._pendulum, self._arm, self._settings = pendulum, arm, settings
        self._seed, self._workers, self._done = seed, workers, done
        self._plant = make_plant(arm, settings, h)
        self._parameters = pendulum.parameters(linearised=settings.plant.linearised)

    def run(self, name: str, kernel: PolicyKernel) -> TrialResults:
        """Run all trials of a policy for compiled loops."""
        trials = self._trials()
        run_over_cores(
            self._plant,
            kernel,
            self._parameters,
            trials,
            duration=self._settings.evaluation.duration,
            seed=self._seed,
            stream=TEST,
            workers=self._workers,
            done=self._done,
        )
        return self._results(name, trials)

    def run_in_python(self, name: str, policy: Policy) -> TrialResults:
        """Run all trials of a policy written in Python."""
        trials = self._trials()
        longest = round(self._settings.evaluation.duration / self._plant.h)
        for i in range(len(trials.steps)):
            own: PendulumParameters = scaled(
                self._parameters, float(trials.inertia_factor[i]), float(trials.friction_factor[i])
            )
            trials.cause[i], rows = record_trial(
                self._plant, policy, own, trials.start[i], longest, self._seed, TEST, i
            )
            trials.steps[i] = len(rows.u)
            self._done(1)
        return self._results(name, trials)

    def evaluation(self, policy: str, results: TrialResults, with_yardsticks: bool) -> Evaluation:
        """Return the evaluation, the yardsticks run if asked for."""
        beside = yardsticks(self._parameters, self._plant.h) if with_yardsticks else {}
        return Evaluation(
            policy=policy,
            world="model",
            arm=self._arm.name,
            arm_digest=self._arm.digest,
            pendulum=self._pendulum.digest,
            settings=self._settings,
            seed=self._seed,
            results=results,
            yardsticks=tuple(self.run(name, kernel) for name, kernel in beside.items()),
        )

    def _trials(self) -> Trials:
        count = self._settings.evaluation.trials
        return draw_trials(count, self._settings, self._seed, TEST, spread=1.0)

    def _results(self, name: str, trials: Trials) -> TrialResults:
        return TrialResults(
            name=name,
            survival=tuple(round(steps * self._plant.h, 6) for steps in trials.steps.tolist()),
            causes=tuple(CAUSES[cause] for cause in trials.cause.tolist()),
        )
