"""Certificates: `equipoise evaluate --claim` and `equipoise evaluate --verify`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output

if TYPE_CHECKING:
    from equipoise.control.policy import TaskPolicy
    from equipoise.executors import Workers
    from equipoise.worlds.certification import Certificate, Repetition

TRAIN_MORE = ("train", "PENDULUM", "--learners", "12")
"""Next command after a policy has failed: twice the default number of learners."""


def certify(
    output: Output,
    policy: Path | None,
    chosen: "TaskPolicy",
    probability: float,
    confidence: float,
    duration: float,
    world: str,
    trials: int | None,
    workers: "Workers",
    out: Path | None,
    force: bool,
) -> None:
    """Grant or refuse a claim about a policy, and write the certificate."""
    from equipoise.worlds import certification as study

    def evaluation_beside(path: Path) -> tuple[Path]:
        return (study.evaluation_path(path),)

    destination = choose_file(
        output, out, "certificate.json", policy, force=force, beside=evaluation_beside
    )
    claim = study.make_claim(probability, confidence, duration, world=world, trials=trials)
    test = f"{claim.trials:,} trials, {claim.allowed:,} failures allowed"
    output.rows({"claim": claim.text, "test": test})
    with output.trials("evaluate", chosen, world, claim.trials) as done:
        certificate, evaluation = study.certify(chosen, claim, workers=workers, done=done)
    with destination.claimed() as out:
        beside = study.evaluation_path(out)
        inputs = {"policy": certificate.policy, "pendulum": evaluation.pendulum}
        evaluation.save(beside, command="evaluate", inputs=inputs)
        inputs = {"policy": certificate.policy, "evaluation": certificate.evaluation}
        certificate.save(out, command="evaluate", inputs=inputs)
    _say(output, certificate)
    output.wrote(out, beside)
    again = ("evaluate", policy, "--verify", out)
    output.next(*(again if certificate.granted else TRAIN_MORE))
    output.result(
        granted=certificate.granted,
        **_claimed(certificate),
        failures=certificate.failed,
        allowed=claim.allowed,
        causes=certificate.failures,
        seed=certificate.seed,
        certificate=out,
        evaluation=beside,
        bad=not certificate.granted,
    )


def repeat(
    output: Output, file: Path, policy: Path | None, chosen: "TaskPolicy", workers: "Workers"
) -> None:
    """Repeat the trials of a certificate, and compare the outcome.

    Raises:
        ArtefactError: The file is no certificate, is one of another policy, or does not match the
            trials beside it.
    """
    from equipoise.worlds import certification as study

    certificate = study.Certificate.load(file)
    if (trials := study.evaluation_path(file)).exists():
        study.check_evaluation(certificate, trials)
    claim = certificate.claim
    output.rows({"claim": claim.text})
    study.check_policy(certificate, chosen)
    with output.trials("repeat", chosen, claim.world, claim.trials) as done:
        again = study.repeat(certificate, chosen, workers=workers, done=done)
    _say_repeated(output, certificate, again)
    output.next("evaluate", policy, "--world", claim.world)
    output.result(
        granted=again.granted,
        **_claimed(certificate),
        failures=sum(again.failures.values()),
        causes=dict(again.failures),
        same_outcome=again.same_outcome,
        same_trials=again.same_trials,
        certificate=file,
        bad=not again.same_outcome,
    )


def _claimed(certificate: "Certificate") -> dict[str, Any]:
    claim = certificate.claim
    return {
        "claim": claim.model_dump(mode="json"),
        "bound": certificate.bound,
        "trials": claim.trials,
    }


def _say(output: Output, certificate: "Certificate") -> None:
    from equipoise.worlds.certification import percentage
    from equipoise.worlds.formatting import format_failures

    claim = certificate.claim
    # Rounded down, since a lower bound must not exceed its value.
    bound = math.floor(1e5 * certificate.bound) / 1e5
    output.rows(
        {
            "outcome": f"{claim.trials - certificate.failed:,} of {claim.trials:,} lasted; "
            f"{format_failures(certificate.failures)}",
            "proves": f"a probability of at least {percentage(bound)}, at "
            f"{percentage(claim.confidence)} confidence",
            "seed": f"{certificate.seed}, from policy and claim: a second attempt is the same",
        }
    )
    count = f"{certificate.failed:,} failures, {claim.allowed:,} allowed."
    if certificate.granted:
        output.say(f"Granted: {count}", style="green")
    else:
        output.say(
            f"Refused: {count} That does not disprove the claim; these trials do not support it.",
            style="red",
        )


def _say_repeated(output: Output, certificate: "Certificate", again: "Repetition") -> None:
    from equipoise.worlds.formatting import format_failures

    trials = f"{certificate.claim.trials:,} trials again: {format_failures(again.failures)}"
    verdict, before = ("granted" if one.granted else "refused" for one in (again, certificate))
    if not again.same_outcome:
        known = format_failures(certificate.failures)
        text = f"Not repeated: {trials}, {verdict}; the certificate says {known}, {before}."
    elif again.same_trials:
        text = f"Repeated: {trials}; each lasted as long as before, {verdict}."
    else:
        text = (
            f"Repeated: {trials}; the same counts as before, {verdict}, but some trials lasted "
            "differently: another processor or library rounds differently."
        )
    output.say(text, style="green" if again.same_outcome else "red")
