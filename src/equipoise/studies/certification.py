"""Certify: grant a claim about a policy, or refuse it, by an exact bound.

A claim says: on this world the policy lasts so long with at least this probability p, and the proof
shall have this confidence. It is granted where the one-sided lower bound of Clopper and Pearson on
what n trials showed reaches p; that is, where a policy that lasts with a probability of p itself
would do as well in at most 1 - confidence of all cases.

The bound holds for trials that were fixed beforehand. So n is part of the claim, and the seed of
the trials comes from SHA-256 over policy and claim: whoever tries again runs the same trials again.
Another policy or another claim is another try, and each try has its own chance to be granted
wrongly: of a hundred policies that just miss the claim, up to five pass at 95 %.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Final, NamedTuple, Self

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
from equipoise.evaluation import Done, Evaluation, evaluate
from equipoise.model.sim_configs import MODEL, NEWEST, PREFIX, SETS, TwinSettings, World, read_world
from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS, Settings
from equipoise.studies.formatting import LASTED

MARGIN: Final = 10.0
"""The number of trials is chosen for a policy that fails so many times less often than the claim
allows ..."""
GRANTED_SHARE: Final = 0.95
"""... which shall be granted its claim with at least this probability."""
ROUND_NUMBERS: Final = tuple(digit * 10**power for power in range(6) for digit in (1, 2, 5))
"""What a number of trials is chosen from: no other leaves so little to be tuned."""
BOUND_TOLERANCE: Final = 1e-9
"""The bound of one file, computed by two versions of SciPy, differs by less."""


class Claim(Value):
    """What is claimed about a policy, and how many trials decide about it."""

    probability: float = Field(gt=0.0, lt=1.0)
    """A trial lasts with at least this probability."""
    confidence: float = Field(ge=0.5, lt=1.0)
    """A policy that does not deserve the claim is refused with at least this probability."""
    duration: float = Field(ge=paper.STEP, le=LONGEST_TRIAL)
    """Length of a trial [s]."""
    world: Name
    """Where the trials run, as `--world` names it; a named set with its version."""
    trials: int = Field(ge=1, le=MOST_TRIALS)
    """Number of trials, fixed in advance."""

    @property
    def allowed(self) -> int:
        """How many failures the claim survives; -1 where the trials are too few for it."""
        return self.trials - least_successes(self.trials, self.probability, self.confidence)

    @property
    def words(self) -> str:
        """The claim as a sentence."""
        return (
            f"lasts {self.duration:g} s with a probability of at least "
            f"{percentage(self.probability)}, at {percentage(self.confidence)} confidence, world "
            f"{self.world}"
        )


class Certificate(Artefact):
    """A claim that was granted or refused, and all that is needed to try it again."""

    FORMAT: ClassVar[str] = "equipoise-certificate"
    VERSION: ClassVar[int] = 1

    claim: Claim
    """What was claimed."""
    granted: bool
    """Whether the trials support it."""
    bound: Share
    """A trial lasts with at least this probability, at the confidence of the claim (Clopper and
    Pearson, one-sided)."""
    failures: dict[Name, Count]
    """How many trials ended in which way before their time."""
    policy: Name
    """Digest of the policy; that of a table covers arm and pendulum, which the evaluation names for
    any policy."""
    arm: Name
    """Name of the arm."""
    world_settings: TwinSettings | None
    """The numbers of the twin; none on the training plant, which the settings describe."""
    settings: Settings
    """Resolved settings: starts, noise, number and length of the trials."""
    seed: Seed
    """Master seed of the trials, derived from policy and claim."""
    evaluation: Name
    """Digest of the evaluation that holds the trials."""

    @property
    def failed(self) -> int:
        """How many trials did not last."""
        return sum(self.failures.values())

    @model_validator(mode="after")
    def _follows_from_its_trials(self) -> Self:
        claim, asked = self.claim, self.settings.evaluation
        if not 0 <= self.failed <= claim.trials or min(self.failures.values(), default=1) < 1:
            raise ValueError(f"{self.failures} are no failures of {claim.trials} trials")
        if (asked.trials, asked.duration) != (claim.trials, claim.duration):
            raise ValueError("the settings are not those of the claim")
        if not self._numbers_are_those_of_the_world():
            raise ValueError(f"the numbers of the world are not those of {claim.world}")
        if self.seed != trial_seed(self.policy, claim):
            raise ValueError("the seed is not that of policy and claim")
        if self.granted != (self.failed <= claim.allowed):
            raise ValueError("the failures do not decide so about the claim")
        bound = lower_bound(claim.trials - self.failed, claim.trials, claim.confidence)
        if abs(self.bound - bound) > BOUND_TOLERANCE:
            raise ValueError("the bound is not that of its failures")
        return self

    def _numbers_are_those_of_the_world(self) -> bool:
        world = self.claim.world
        if world == MODEL or self.world_settings is None:
            return world == MODEL and self.world_settings is None
        # Only a file can say what it likes; the named sets are frozen.
        frozen = world.removeprefix(PREFIX) in SETS
        return not frozen or self.world_settings == read_world(world).settings


class Repetition(NamedTuple):
    """What came of the trials of a certificate, run again."""

    granted: bool
    """Whether the claim is granted this time."""
    failures: Mapping[str, int]
    """How many trials ended in which way before their time."""
    same_outcome: bool
    """As many failures of each kind as the certificate has."""
    same_trials: bool
    """Each trial lasted exactly as long. Another processor or library may round otherwise."""


def least_successes(trials: int, probability: float, confidence: float) -> int:
    """Return the least number of successes that grants a claim.

    It is the least s with P(X >= s) <= 1 - confidence for X binomial with `trials` and
    `probability`: the least s whose one-sided lower Clopper-Pearson bound reaches `probability`.

    Args:
        trials: Number of trials.
        probability: The claimed probability of a success.
        confidence: The confidence.

    Returns:
        The number; trials + 1 where even a success in every trial does not suffice.

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
    """Return how many trials decide about a claim where nobody says otherwise.

    The least of 1, 2, 5, 10, 20, 50, ... with which a policy that fails ten times less often than
    the claim allows is granted it with a probability of at least 0.95.

    Args:
        probability: The claimed probability that a trial lasts.
        confidence: The confidence.

    Raises:
        InputError: It takes more trials than anybody runs.

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
    """Return a claim, with its world and its number of trials settled.

    Args:
        probability: A trial lasts with at least this probability.
        confidence: The confidence of the proof.
        duration: Length of a trial [s].
        world: Where the trials run: `model`, `twin:nominal`, `twin:harsh`, `twin:FILE`.
        trials: Number of trials; by default `trials_for` the claim.

    Raises:
        InputError: Nobody can claim that, or the trials are too few to grant it.
        SettingsError: There is no such world.
    """
    if world != MODEL:
        read_world(world)
        name = world.removeprefix(PREFIX)
        world = PREFIX + NEWEST.get(name, name)
    given = {"probability": probability, "confidence": confidence, "duration": duration}
    try:
        claim = Claim(**given, world=world, trials=1 if trials is None else trials)
    except ValidationError as error:
        fault = first_fault(error)
        raise InputError(
            f"{fault.where} is {fault.got}; {fault.what.replace('Input', 'it')}"
        ) from None
    steps = duration / paper.STEP
    if abs(steps - round(steps)) > 1e-6:
        raise InputError(
            f"duration is {duration:g} s, no whole number of steps of {paper.STEP:g} s; round it"
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
    return int(value_digest(_Try(policy=policy, claim=claim)).removeprefix(DIGEST_PREFIX)[:8], 16)


class _Try(Value):
    """What the seed is a digest of."""

    policy: str
    claim: Claim


def certify(
    policy: TaskPolicy,
    claim: Claim,
    *,
    workers: int = 1,
    partial: StrPath | None = None,
    done: Done = lambda _: None,
) -> tuple[Certificate, Evaluation]:
    """Put a claim about a policy to the test.

    Args:
        policy: The policy.
        claim: What is claimed about it, from `make_claim`.
        workers: Number of threads; the result does not depend on it.
        partial: File that keeps the finished trials on a twin until all are done.
        done: Called with the number of trials that have just finished.

    Returns:
        The certificate, granted or refused, and its trials.
    """
    numbers = None if claim.world == MODEL else read_world(claim.world).settings
    return _try(policy, claim, numbers, policy.settings, workers, partial, done)


def check_policy(certificate: Certificate, policy: TaskPolicy) -> None:
    """Check that a certificate is about a policy.

    Raises:
        ArtefactError: The certificate is about another policy.
    """
    if policy.digest != certificate.policy:
        raise ArtefactError(
            f"the certificate is about another policy ({certificate.policy[:19]}...), not about "
            f"this one ({policy.digest[:19]}...); give that one"
        )


def repeat(
    certificate: Certificate,
    policy: TaskPolicy,
    *,
    workers: int = 1,
    done: Done = lambda _: None,
) -> Repetition:
    """Run all trials of a certificate again, on the world as the certificate has it.

    Args:
        certificate: The certificate.
        policy: The policy that it is about.
        workers: Number of threads; the result does not depend on it.
        done: Called with the number of trials that have just finished.

    Raises:
        ArtefactError: The certificate is about another policy.
    """
    check_policy(certificate, policy)
    numbers = certificate.world_settings
    again, evaluation = _try(
        policy, certificate.claim, numbers, certificate.settings, workers, None, done
    )
    return Repetition(
        granted=again.granted,
        failures=again.failures,
        same_outcome=again.failures == certificate.failures,
        same_trials=evaluation.digest == certificate.evaluation,
    )


def _try(
    policy: TaskPolicy,
    claim: Claim,
    numbers: TwinSettings | None,
    settings: Settings,
    workers: int,
    partial: StrPath | None,
    done: Done,
) -> tuple[Certificate, Evaluation]:
    """Run the trials of a claim, on the training plant or on a twin with these numbers."""
    asked = {"trials": claim.trials, "duration": claim.duration}
    trials = settings.evaluation.model_copy(update=asked)
    evaluation = evaluate(
        policy,
        settings.model_copy(update={"evaluation": trials}),
        seed=trial_seed(policy.digest, claim),
        world=MODEL if numbers is None else World(claim.world, numbers),
        with_baselines=False,
        workers=workers,
        partial=partial,
        done=done,
    )
    failures = _failures(evaluation)
    failed = sum(failures.values())
    certificate = Certificate(
        claim=claim,
        granted=failed <= claim.allowed,
        bound=lower_bound(claim.trials - failed, claim.trials, claim.confidence),
        failures=failures,
        policy=policy.digest,
        arm=policy.arm.name,
        world_settings=numbers,
        settings=evaluation.settings,
        seed=evaluation.seed,
        evaluation=evaluation.digest,
    )
    return certificate, evaluation


def evaluation_path(certificate: Path) -> Path:
    """Return where the trials of a certificate lie: beside it."""
    return certificate.with_name(f"{certificate.stem}-evaluation.json")


def check_evaluation(certificate: Certificate, path: Path) -> None:
    """Check that an evaluation file holds the trials of a certificate.

    Raises:
        ArtefactError: It is damaged, or holds others.
    """
    evaluation = Evaluation.load(path)
    if evaluation.digest != certificate.evaluation or _failures(evaluation) != certificate.failures:
        raise ArtefactError(
            f"{path} does not hold the trials of the certificate beside it; certify again"
        )


def percentage(share: float) -> str:
    """Return a share in per cent with all its digits.

    Example:
        >>> percentage(0.999)
        '99.9 %'
    """
    return f"{100.0 * share:.10g} %"


def _failures(evaluation: Evaluation) -> dict[str, int]:
    causes = evaluation.results.summary().causes
    return {cause: causes[cause] for cause in sorted(causes) if cause != LASTED}
