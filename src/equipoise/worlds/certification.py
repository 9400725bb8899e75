"""Certificates: claims about a policy, granted or refused by an exact bound.

A claim states a world, a duration, and a probability p to last for it, at a confidence. It is
granted if the one-sided lower Clopper-Pearson bound of n trials reaches p: a policy with a
probability of p itself would succeed as often with a probability of at most 1 - confidence.

The bound requires trials that are fixed in advance. So n is part of the claim, and SHA-256 over
policy and claim gives the seed of the trials: a second attempt runs the same trials. Another policy
or claim is another test with its own false positives: of a hundred policies that just miss the
claim, up to five pass at 95 %.
"""

import hashlib
import json
import math
from bisect import bisect_left
from typing import ClassVar, Final, Self

from pydantic import Field, ValidationError, model_validator
from scipy.special import bdtrc

from equipoise import paper
from equipoise.arguments import Workers, checked
from equipoise.artefacts import Artefact, Name, Value, first_fault
from equipoise.control.bound_policy import AnyPolicy, read_policy
from equipoise.errors import InputError
from equipoise.model.worlds import MODEL, read_world
from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS
from equipoise.worlds.evaluation import Evaluation, evaluate, lower_bound
from equipoise.worlds.interface import Done

ROUND_NUMBERS: Final = (
    *(digit * 10**power for power in range(6) for digit in (1, 2, 5)),
    MOST_TRIALS,
)
"""Possible numbers of trials; round numbers leave little room for tuning."""


class Claim(Value):
    """A claim about a policy, with its number of trials."""

    probability: float = Field(gt=0.0, lt=1.0)
    """Minimum probability that a trial lasts."""
    confidence: float = Field(ge=0.5, lt=1.0)
    """Minimum probability that a policy below the claim is refused."""
    duration: float = Field(ge=paper.STEP, le=LONGEST_TRIAL, multiple_of=paper.STEP)
    """Length of a trial [s]."""
    world: Name
    """World of the trials, as `--world` names it."""
    trials: int = Field(ge=1, le=MOST_TRIALS)
    """Number of trials, fixed in advance."""

    @property
    def allowed(self) -> int:
        """Maximum number of failures; -1 if the trials are too few for the claim."""
        return self.trials - least_successes(self.trials, self.probability, self.confidence)

    def __str__(self) -> str:
        """Return the claim as a sentence."""
        return (
            f"lasts {self.duration:g} s with a probability of at least "
            f"{100.0 * self.probability:.10g} %, at {100.0 * self.confidence:.10g} % confidence, "
            f"world {self.world}"
        )


class Certificate(Artefact):
    """A claim with its trials, which grant or refuse it."""

    FORMAT: ClassVar[str] = "equipoise-certificate"

    claim: Claim
    """The claim."""
    evaluation: Evaluation
    """The trials, with policy, world and settings; the seed is derived from policy and claim."""

    @property
    def failed(self) -> int:
        """Number of failed trials."""
        return self.claim.trials - self.evaluation.results.summary().survived

    @property
    def granted(self) -> bool:
        """Whether the trials support the claim."""
        return self.failed <= self.claim.allowed

    @property
    def bound(self) -> float:
        """Lower bound of the probability that a trial lasts, at the confidence of the claim."""
        claim = self.claim
        return lower_bound(claim.trials - self.failed, claim.trials, claim.confidence)

    @model_validator(mode="after")
    def _has_the_trials_of_its_claim(self) -> Self:
        claim, found = self.claim, self.evaluation
        expected = (claim.world, claim.duration, claim.trials, trial_seed(found.policy, claim))
        trials = len(found.results.survival)
        if (found.world, found.duration, trials, found.seed) != expected:
            raise ValueError(f"expected trials with world, duration, number and seed {expected}")
        return self


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
        return float(bdtrc(successes - 1, trials, probability)) <= 1.0 - confidence

    return bisect_left(range(trials + 1), True, key=convinces)


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
    better = 1.0 - (1.0 - probability) / 10.0
    for trials in ROUND_NUMBERS:
        least = least_successes(trials, probability, confidence)
        if float(bdtrc(least - 1, trials, better)) >= 0.95:
            return trials
    raise InputError(
        f"a probability of {probability:.10g} at a confidence of {confidence:.10g} takes more than "
        f"{MOST_TRIALS:,} trials; claim less"
    )


@checked
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
        raise InputError(f"the claim is invalid: {first_fault(error)}") from None
    if trials is None:
        return claim.model_copy(update={"trials": trials_for(probability, confidence)})
    if claim.allowed < 0:
        least = math.ceil(math.log(1.0 - confidence) / math.log(probability))
        raise InputError(
            f"{trials:,} trials cannot grant this claim, even if all last; give {least:,} or more"
        )
    return claim


def trial_seed(policy: str, claim: Claim) -> int:
    """Return the master seed of the trials: the first 32 bits of SHA-256 over policy and claim.

    Args:
        policy: Digest of the policy.
        claim: The claim.
    """
    source = json.dumps(
        {"policy": policy, "claim": claim.model_dump()}, sort_keys=True, separators=(",", ":")
    )
    return int(hashlib.sha256(source.encode()).hexdigest()[:8], 16)


@checked
def certify(
    policy: AnyPolicy,
    claim: Claim,
    *,
    workers: Workers = 1,
    done: Done = lambda _: None,
) -> Certificate:
    """Test a claim about a policy.

    Args:
        policy: The policy; as in `evaluate`.
        claim: The claim, from `make_claim`.
        workers: Number of threads; the result does not depend on it.
        done: Called with the number of trials that have just finished.

    Returns:
        The certificate, granted or refused.
    """
    policy = read_policy(policy)
    changes = {"trials": claim.trials, "duration": claim.duration}
    trials = policy.settings.evaluation.model_copy(update=changes)
    evaluation = evaluate(
        policy,
        policy.settings.model_copy(update={"evaluation": trials}),
        world=claim.world,
        seed=trial_seed(policy.digest, claim),
        with_baselines=False,
        workers=workers,
        done=done,
    )
    return Certificate(claim=claim, evaluation=evaluation)
