"""Certificates: claims about a policy, granted or refused by an exact bound.

A claim states a world, a duration, and a probability p to last for it, at a confidence. It is
granted if the one-sided lower Clopper-Pearson bound of n trials reaches p: a policy with a
probability of p itself would succeed as often with a probability of at most 1 - confidence.

The bound requires trials that are fixed in advance. So n is part of the claim, and SHA-256 over
policy and claim gives the seed of the trials: a repetition runs the same trials. Another policy or
claim is another test with its own false positives: of a hundred policies that just miss the claim,
up to five pass at 95 %.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator
from scipy.stats import binom, binomtest

from equipoise import paper
from equipoise.artefacts import (
    DIGEST_PREFIX,
    Artefact,
    Count,
    Name,
    Seed,
    Share,
    StrPath,
    Value,
    first_fault,
    value_digest,
)
from equipoise.control.policy import TaskPolicy
from equipoise.errors import ArtefactError, InputError
from equipoise.executors import Workers
from equipoise.model.worlds import MODEL, PREFIX, WORLDS, TwinSettings, World, read_world
from equipoise.outcomes import Outcome
from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS, Settings
from equipoise.worlds.evaluation import Done, Evaluation, evaluate

MARGIN: Final = 10.0
"""Ratio of the claimed failure probability to that of the policy for which the number of trials is
chosen [-]."""
GRANTED_SHARE: Final = 0.95
"""Minimum probability that such a policy is granted its claim [-]."""
ROUND_NUMBERS: Final = (
    *(digit * 10**power for power in range(6) for digit in (1, 2, 5)),
    MOST_TRIALS,
)
"""Possible numbers of trials; round numbers leave little room for tuning."""
BOUND_TOLERANCE: Final = 1e-9
"""Maximum difference of a bound between two versions of SciPy [-]."""


class Claim(Value):
    """A claim about a policy, with its number of trials."""

    probability: float = Field(gt=0.0, lt=1.0)
    """Minimum probability that a trial lasts."""
    confidence: float = Field(ge=0.5, lt=1.0)
    """Minimum probability that a policy below the claim is refused."""
    duration: float = Field(ge=paper.STEP, le=LONGEST_TRIAL)
    """Length of a trial [s]."""
    world: Name
    """World of the trials, as `--world` names it."""
    trials: int = Field(ge=1, le=MOST_TRIALS)
    """Number of trials, fixed in advance."""

    @property
    def allowed(self) -> int:
        """Maximum number of failures; -1 if the trials are too few for the claim."""
        return self.trials - least_successes(self.trials, self.probability, self.confidence)

    @property
    def text(self) -> str:
        """The claim as a sentence."""
        return (
            f"lasts {self.duration:g} s with a probability of at least "
            f"{percentage(self.probability)}, at {percentage(self.confidence)} confidence, world "
            f"{self.world}"
        )


class Certificate(Artefact):
    """A claim, granted or refused, with everything for its repetition."""

    FORMAT: ClassVar[str] = "equipoise-certificate"
    VERSION: ClassVar[int] = 1

    claim: Claim
    """The claim."""
    granted: bool
    """Whether the trials support it."""
    bound: Share
    """One-sided lower Clopper-Pearson bound of the probability that a trial lasts, at the
    confidence of the claim."""
    failures: dict[Outcome, Count]
    """Number of failed trials by cause."""
    policy: Name
    """Digest of the policy; that of a table covers arm and pendulum, which the evaluation names for
    any policy."""
    arm: Name
    """Name of the arm."""
    world_settings: TwinSettings | None
    """Settings of the twin; None on the training plant, which the policy's settings describe."""
    settings: Settings
    """Resolved settings: starts, noise, number and length of the trials."""
    seed: Seed
    """Master seed of the trials, derived from policy and claim."""
    evaluation: Name
    """Digest of the evaluation that holds the trials."""

    @property
    def failed(self) -> int:
        """Number of failed trials."""
        return sum(self.failures.values())

    @model_validator(mode="after")
    def _follows_from_its_trials(self) -> Self:
        claim, evaluation, twin = self.claim, self.settings.evaluation, self.world_settings
        if not 0 <= self.failed <= claim.trials or min(self.failures.values(), default=1) < 1:
            raise ValueError(f"{self.failures} are no failures of {claim.trials} trials")
        if (evaluation.trials, evaluation.duration) != (claim.trials, claim.duration):
            raise ValueError("the settings are not those of the claim")
        # The named sets are frozen; only a file may have other numbers.
        frozen = claim.world.removeprefix(PREFIX) in WORLDS
        known = read_world(claim.world).settings if frozen else twin
        if (twin is None) != (claim.world == MODEL) or twin != known:
            raise ValueError(f"the numbers of the world are not those of {claim.world}")
        if self.seed != trial_seed(self.policy, claim):
            raise ValueError("the seed is not that of policy and claim")
        if self.granted != (self.failed <= claim.allowed):
            raise ValueError("the verdict is not that of the failures")
        bound = lower_bound(claim.trials - self.failed, claim.trials, claim.confidence)
        if abs(self.bound - bound) > BOUND_TOLERANCE:
            raise ValueError("the bound is not that of its failures")
        return self


class Repetition(NamedTuple):
    """Result of repeating the trials of a certificate."""

    granted: bool
    """Whether the repetition grants the claim."""
    failures: Mapping[Outcome, int]
    """Number of failed trials by cause."""
    same_outcome: bool
    """Whether these are the failures of the certificate."""
    same_trials: bool
    """Whether each trial lasted exactly as long; another processor or library may round
    differently."""


def least_successes(trials: int, probability: float, confidence: float) -> int:
    """Return the minimum number of successes that grants a claim.

    It is the minimum s with P(X >= s) <= 1 - confidence for X binomial with `trials` and
    `probability`: the minimum s whose one-sided lower Clopper-Pearson bound reaches `probability`.

    Args:
        trials: Number of trials.
        probability: The claimed probability of a success.
        confidence: The confidence.

    Returns:
        The number; trials + 1 if a success in every trial does not suffice.

    Example:
        >>> least_successes(1000, 0.99, 0.95)
        996
    """

    def convinces(successes: int) -> bool:
        return float(binom.sf(successes - 1, trials, probability)) <= 1.0 - confidence

    return bisect_left(range(trials + 1), True, key=convinces)


def lower_bound(successes: int, trials: int, confidence: float) -> float:
    """Return the exact (Clopper-Pearson) one-sided lower bound of the probability of a success."""
    test = binomtest(successes, trials, alternative="greater")
    return float(test.proportion_ci(confidence, method="exact").low)


def trials_for(probability: float, confidence: float) -> int:
    """Return the default number of trials for a claim.

    It is the minimum of 1, 2, 5, 10, 20, 50, ... at which a policy with a tenth of the claimed
    failure probability is granted the claim with a probability of at least 0.95.

    Args:
        probability: The claimed probability that a trial lasts.
        confidence: The confidence.

    Raises:
        InputError: The claim takes more than the maximum number of trials.

    Example:
        >>> trials_for(0.99, 0.95), trials_for(0.999, 0.95)
        (1000, 10000)
    """
    better = 1.0 - (1.0 - probability) / MARGIN
    for trials in ROUND_NUMBERS:
        least = least_successes(trials, probability, confidence)
        if float(binom.sf(least - 1, trials, better)) >= GRANTED_SHARE:
            return trials
    raise InputError(
        f"{percentage(probability)} at {percentage(confidence)} confidence takes more than "
        f"{ROUND_NUMBERS[-1]:,} trials; claim less"
    )


def make_claim(
    probability: float = 0.99,
    confidence: float = 0.95,
    duration: float = 60.0,
    *,
    world: str = MODEL,
    trials: int | None = None,
) -> Claim:
    """Return a validated claim.

    Args:
        probability: Minimum probability that a trial lasts.
        confidence: Confidence of the verdict.
        duration: Length of a trial [s].
        world: World of the trials: `model`, `twin:nominal`, `twin:harsh`, `twin:FILE`.
        trials: Number of trials (default: `trials_for` the claim).

    Raises:
        InputError: A value is out of range, or the trials are too few to grant the claim.
        SettingsError: The world is unknown.
    """
    if world != MODEL:
        read_world(world)
    given = {"probability": probability, "confidence": confidence, "duration": duration}
    try:
        claim = Claim(**given, world=world, trials=1 if trials is None else trials)
    except ValidationError as error:
        fault = first_fault(error)
        text = f"{fault.where} is {fault.got}; {fault.what.replace('Input', 'it')}"
        raise InputError(text) from None
    if abs(math.remainder(duration / paper.STEP, 1.0)) > 1e-6:
        raise InputError(
            f"duration is {duration:g} s, not a multiple of the step of {paper.STEP:g} s; round it"
        )
    if trials is None:
        return claim.model_copy(update={"trials": trials_for(probability, confidence)})
    if claim.allowed < 0:
        least = math.ceil(math.log(1.0 - confidence) / math.log(probability))
        raise InputError(
            f"{trials:,} trials cannot grant {percentage(probability)} at "
            f"{percentage(confidence)} confidence, even if all last; give {least:,} or more"
        )
    return claim


def trial_seed(policy: str, claim: Claim) -> int:
    """Return the master seed of the trials: the first 32 bits of SHA-256 over policy and claim.

    Args:
        policy: Digest of the policy.
        claim: The claim.
    """
    digest = value_digest(_SeedSource(policy=policy, claim=claim))
    return int(digest.removeprefix(DIGEST_PREFIX)[:8], 16)


class _SeedSource(Value):
    policy: str
    claim: Claim


def certify(
    policy: TaskPolicy,
    claim: Claim,
    *,
    workers: Workers = 1,
    partial: StrPath | None = None,
    done: Done = lambda _: None,
) -> tuple[Certificate, Evaluation]:
    """Test a claim about a policy.

    Args:
        policy: The policy.
        claim: The claim, from `make_claim`.
        workers: Number of threads, or an executor; the result does not depend on it.
        partial: File for the finished trials until all are done.
        done: Called with the number of trials that have just finished.

    Returns:
        The certificate, granted or refused, and its trials.
    """
    twin = None if claim.world == MODEL else read_world(claim.world).settings
    return _test(policy, claim, twin, policy.settings, workers=workers, partial=partial, done=done)


def check_policy(certificate: Certificate, policy: TaskPolicy) -> None:
    """Check that a certificate belongs to a policy.

    Raises:
        ArtefactError: The certificate belongs to another policy.
    """
    if policy.digest != certificate.policy:
        raise ArtefactError(
            f"the certificate is about another policy, {certificate.policy[:19]}...; given is "
            f"{policy.digest[:19]}...; give the policy of the certificate"
        )


def repeat(
    certificate: Certificate,
    policy: TaskPolicy,
    *,
    workers: Workers = 1,
    done: Done = lambda _: None,
) -> Repetition:
    """Repeat all trials of a certificate, with its own settings of the world.

    Args:
        certificate: The certificate.
        policy: The policy of the certificate.
        workers: Number of threads, or an executor; the result does not depend on it.
        done: Called with the number of trials that have just finished.

    Raises:
        ArtefactError: The certificate belongs to another policy.
    """
    check_policy(certificate, policy)
    claim, twin, settings = certificate.claim, certificate.world_settings, certificate.settings
    again, evaluation = _test(
        policy, claim, twin, settings, workers=workers, partial=None, done=done
    )
    same_outcome = again.failures == certificate.failures
    same_trials = evaluation.digest == certificate.evaluation
    return Repetition(again.granted, again.failures, same_outcome, same_trials)


def _test(
    policy: TaskPolicy, claim: Claim, twin: TwinSettings | None, settings: Settings, **options: Any
) -> tuple[Certificate, Evaluation]:
    """Run the trials of a claim, on the training plant or on a twin with these settings.

    Args:
        policy: The policy.
        claim: The claim.
        twin: Settings of the twin; None for the training plant.
        settings: Settings of the trials.
        options: Workers, checkpoints and progress, as `evaluate` takes them.
    """
    changes = {"trials": claim.trials, "duration": claim.duration}
    trials = settings.evaluation.model_copy(update=changes)
    settings = settings.model_copy(update={"evaluation": trials})
    world, seed = (
        MODEL if twin is None else World(claim.world, twin),
        trial_seed(policy.digest, claim),
    )
    evaluation = evaluate(policy, settings, world=world, seed=seed, with_baselines=False, **options)
    failures = _failures(evaluation)
    failed = sum(failures.values())
    certificate = Certificate(
        claim=claim,
        granted=failed <= claim.allowed,
        bound=lower_bound(claim.trials - failed, claim.trials, claim.confidence),
        failures=failures,
        policy=policy.digest,
        arm=policy.arm.name,
        world_settings=twin,
        settings=evaluation.settings,
        seed=evaluation.seed,
        evaluation=evaluation.digest,
    )
    return certificate, evaluation


def evaluation_path(certificate: Path) -> Path:
    """Return the path of a certificate's trials, beside it."""
    return certificate.with_name(f"{certificate.stem}-evaluation.json")


def check_evaluation(certificate: Certificate, path: Path) -> None:
    """Check that an evaluation file holds the trials of a certificate.

    Raises:
        ArtefactError: The file is damaged, or holds other trials.
    """
    evaluation = Evaluation.load(path)
    if evaluation.digest != certificate.evaluation or _failures(evaluation) != certificate.failures:
        raise ArtefactError(
            f"{path} does not hold the trials of the certificate beside it; certify again"
        )


def percentage(share: float) -> str:
    """Return a share in per cent with all digits.

    Example:
        >>> percentage(0.999)
        '99.9 %'
    """
    return f"{100.0 * share:.10g} %"


def _failures(evaluation: Evaluation) -> dict[Outcome, int]:
    outcomes = evaluation.results.summary().outcomes
    return {each: outcomes[each] for each in sorted(outcomes) if each != Outcome.LASTED}
