"""Evaluation of a policy: survival with its confidence interval, and causes of failure.

Trials start as after a release by hand, or with a hanging pendulum that the arm swings up
(`evaluation.start`). They run on plants that vary around the policy's pendulum: on the paper's
plant (world `ideal`), on the plant of the training with the identified actuator (`model`), on a
digital twin (`twin:...`), or in another world. Any policy runs in any world. Test
seeds serve no other purpose, trial i is the same for every policy, and the baselines run the same
trials.
"""

from bisect import bisect_left
from collections import Counter
from typing import Annotated, ClassVar, Final, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import bdtr, betaincinv

from equipoise.arguments import Workers, checked
from equipoise.control.bound_policy import AnyPolicy, read_policy
from equipoise.control.linear import baselines
from equipoise.control.policy import KernelPolicy, TaskPolicy
from equipoise.errors import InputError
from equipoise.files import Artefact, Name, Seed, StrPath, Value
from equipoise.model.actuator import Actuator
from equipoise.model.random import TEST
from equipoise.model.worlds import MODEL, TwinSettings, World
from equipoise.outcomes import TRIAL_OUTCOMES, Outcome
from equipoise.settings import MAX_TRIAL_DURATION, MAX_TRIALS, Settings
from equipoise.simulation import Trials, setup_of, simulate
from equipoise.simulation.interface import Done

Survival = Annotated[float, Field(ge=0.0, le=MAX_TRIAL_DURATION)]
"""Duration of a trial [s]."""


class Summary(NamedTuple):
    """Statistics of the trials of one policy; derived, never stored."""

    trials: int
    survived: int
    rate: float
    """Fraction of the trials without a failure."""
    interval: tuple[float, float]
    """Exact (Clopper-Pearson) 95 % interval of the survival rate."""
    median: float
    """Median survival [s]."""
    outcomes: dict[Outcome, int]
    """Number of trials by their outcome."""
    upright: tuple[float, float] | None
    """Median and maximum of the time to upright [s], of trials that began hanging and came up."""


def lower_bound(successes: int, trials: int, confidence: float) -> float:
    """Return the exact (Clopper-Pearson) one-sided lower bound of the probability of a success."""
    if successes == 0:
        return 0.0
    return float(betaincinv(successes, trials - successes + 1, 1.0 - confidence))


def exact_interval(count: int, of: int) -> tuple[float, float]:
    """Return the exact (Clopper-Pearson) 95 % interval of a fraction.

    Args:
        count: Number of successes.
        of: Number of trials, at least one.
    """
    return lower_bound(count, of, 0.975), 1.0 - lower_bound(of - count, of, 0.975)


CLAIM_CONFIDENCE: Final = 0.95
"""Minimum probability that a claim is refused for a policy below it [-]."""


def allowed_failures(trials: int, claim: float) -> int:
    """Return the maximum number of failed trials that grants a claim; -1 if none does.

    A claim is granted if the exact lower bound of the probability to survive a trial reaches it.

    Args:
        trials: Number of trials, fixed in advance.
        claim: Claimed probability to survive a trial [-].

    Example:
        >>> allowed_failures(1000, 0.99), allowed_failures(298, 0.99)
        (4, -1)
    """

    def refused(failures: int) -> bool:
        return lower_bound(trials - failures, trials, CLAIM_CONFIDENCE) < claim

    return bisect_left(range(trials + 1), True, key=refused) - 1


def trials_for(claim: float) -> int:
    """Return the default number of trials of a claim.

    With it, a policy with a tenth of the claimed failure probability is granted the claim with a
    probability of at least 0.95. Round numbers leave little room for tuning.

    Args:
        claim: Claimed probability to survive a trial [-].

    Raises:
        InputError: The claim takes more than the maximum number of trials.

    Example:
        >>> trials_for(0.99), trials_for(0.999)
        (1000, 10000)
    """
    for trials in (digit * 10**power for power in range(6) for digit in (1, 2, 5)):
        allowed = allowed_failures(trials, claim)
        if allowed >= 0 and float(bdtr(allowed, trials, 0.1 * (1.0 - claim))) >= 0.95:
            return trials
    raise InputError(
        f"a claim of {claim:.10g} takes more than {MAX_TRIALS:,} trials; claim a lower probability"
    )


class TrialResults(Value):
    """The trials of one policy, in their order."""

    name: Name
    """Name of the policy."""
    survival: Annotated[tuple[Survival, ...], Field(min_length=1, max_length=MAX_TRIALS)]
    """Duration of each trial [s]."""
    outcomes: Annotated[tuple[Outcome, ...], Field(max_length=MAX_TRIALS)]
    """Outcome of each trial."""
    upright: Annotated[tuple[Survival, ...], Field(max_length=MAX_TRIALS)] = ()
    """Duration of the swing-up before each trial [s]; empty after starts by hand."""

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        trials = len(self.survival)
        if len(self.outcomes) != trials or len(self.upright) not in (0, trials):
            raise ValueError(f"{trials} trials need as many outcomes and swing-ups")
        return self

    def summary(self) -> Summary:
        """Return fraction, interval, median and outcomes."""
        trials, survived = len(self.survival), self.outcomes.count(Outcome.SURVIVED)
        rate, interval = survived / trials, exact_interval(survived, trials)
        median, outcomes = float(np.median(self.survival)), dict(Counter(self.outcomes))
        times = [time for time, s in zip(self.upright, self.survival, strict=False) if s > 0.0]
        upright = (float(np.median(times)), max(times)) if times else None
        return Summary(trials, survived, rate, interval, median, outcomes, upright)


def trial_results(name: str, trials: Trials, h: float) -> TrialResults:
    """Return the results of finished trials.

    Args:
        name: Name of the policy.
        trials: Trials with their results.
        h: Time step [s].
    """
    survival = tuple(round(steps * h, 6) for steps in trials.steps.tolist())
    outcomes = tuple(TRIAL_OUTCOMES[code] for code in trials.cause.tolist())
    upright = tuple(
        round(steps * h, 6) for steps in trials.upright.tolist() if trials.upright.any()
    )
    return TrialResults(name=name, survival=survival, outcomes=outcomes, upright=upright)


class Evaluation(Artefact):
    """All trials of a policy and of the baselines."""

    FORMAT: ClassVar[str] = "equipoise-evaluation"

    policy: Name
    """Digest of the policy's file or source."""
    world: Name
    """World of the trials."""
    world_settings: TwinSettings | None
    """Numbers of the twin; `None` on a plant or a kinematic arm."""
    arm: Name
    """Name of the arm."""
    arm_digest: Name
    """Digest of the arm."""
    actuator: Name
    """Digest of the controller's model of the arm's response."""
    pendulum: Name
    """Digest of the pendulum that the trials vary."""
    settings: Settings
    """Resolved settings: starts, noise, number and length of the trials."""
    seed: Seed
    """Master seed; with the number of a trial it determines its conditions and noise."""
    results: TrialResults
    """Trials of the policy."""
    baselines: Annotated[tuple[TrialResults, ...], Field(max_length=16)]
    """Trials of the baselines, on the same conditions."""

    def __repr__(self) -> str:
        """Return one line: world, number of trials without a failure, and survival."""
        found = self.results.summary()
        low, high = found.interval
        where = f"{self.results.name!r} in {self.world!r}"
        survived = f"{found.survived} of {found.trials} trials survived {self.duration:g} s"
        interval = f"(95 %: {low:.3f} to {high:.3f})"
        return f"<Evaluation of {where}: {survived} {interval}, median {found.median:.3g} s>"

    __str__ = __repr__

    @property
    def duration(self) -> float:
        """Length of a trial [s]."""
        return self.settings.evaluation.duration


@checked
def evaluate(
    policy: AnyPolicy = None,
    settings: Settings | None = None,
    *,
    world: str | World = MODEL,
    actuator: Actuator | StrPath | None = None,
    seed: Seed = 0,
    with_baselines: bool = True,
    workers: Workers = 1,
    done: Done = lambda _: None,
) -> Evaluation:
    """Evaluate a policy in a simulated world.

    A policy with a kernel runs compiled, on several threads. Other policies run in Python on the
    same trials, about a second per trial of a minute.

    Args:
        policy: A policy with its task, such as a table; its file or name, as `load_policy` takes
            it; or a function, as `bind_policy` takes it. By default the table that ships.
        settings: Number, length and starts of the trials, noise of the plant, the controller
            (default: the policy's).
        world: Name of a world, such as `ideal`, `model` or `twin:nominal`, or a twin with its
            numbers.
        actuator: The controller's model of the arm's response, its file, or `ideal` (default: the
            policy's; in `ideal` always the ideal one).
        seed: Master seed of the trials.
        with_baselines: Run the baselines on the same trials.
        workers: Number of threads for compiled policies, or an executor such as Dask's; the result
            does not depend on it.
        done: Callback; receives the number of trials that have just finished; from Python, parts
            of one.

    Raises:
        SettingsError: The world is unknown.
        ArmError: The masses of the twin's arm are unknown.
    """
    policy = read_policy(policy)
    setup = setup_of(policy, world, settings, actuator)
    pendulum, arm, settings, h = setup.pendulum, setup.arm, setup.settings, setup.h
    simulation = simulate(world, setup, seed=seed, stream=TEST)
    count, span = settings.evaluation.trials, settings.evaluation.duration

    def run(name: str, policy: TaskPolicy | KernelPolicy) -> TrialResults:
        trials = simulation.draw(count)
        simulation.run(policy, trials, duration=span, workers=workers, done=done)
        return trial_results(name, trials, h)

    nominal = pendulum.parameters(linearised=settings.plant.linearised)
    others = baselines(nominal, h) if with_baselines else {}
    return Evaluation(
        policy=policy.digest,
        world=simulation.name,
        world_settings=simulation.twin,
        arm=arm.name,
        arm_digest=arm.digest,
        actuator=setup.actuator.digest,
        pendulum=pendulum.digest,
        settings=settings,
        seed=seed,
        results=run(policy.name, policy),
        baselines=tuple(run(name, KernelPolicy(kernel)) for name, kernel in others.items()),
    )
