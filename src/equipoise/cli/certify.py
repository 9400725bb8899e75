"""`equipoise certify`: a claim about a policy is granted or refused."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli import next_step
from equipoise.cli.destinations import check_output, choose_file
from equipoise.cli.evaluate import trials_of
from equipoise.cli.options import (
    IN_AND_OUT,
    Force,
    Json,
    PolicyFile,
    Workers,
    available_workers,
    read_policy,
)
from equipoise.cli.output import Output, verb

if TYPE_CHECKING:
    from equipoise.studies.certification import Certificate

REFUSED = 1
"""Exit code where the trials do not support the claim."""


@verb
def certify(
    policy: PolicyFile = None,
    probability: Annotated[
        float, typer.Option(metavar="P", help="Claim: a trial lasts with at least this one.")
    ] = 0.99,
    confidence: Annotated[
        float, typer.Option(metavar="C", help="Confidence that the proof shall have.")
    ] = 0.95,
    duration: Annotated[float, typer.Option(metavar="SECONDS", help="Length of a trial.")] = 60.0,
    world: Annotated[
        str,
        typer.Option(
            metavar="WORLD",
            help="Where they run: model, twin:nominal, twin:harsh, or twin:FILE.",
        ),
    ] = "model",
    trials: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Number of trials; by default what the claim takes."),
    ] = None,
    workers: Workers = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The certificate that is written, its trials beside it.",
            rich_help_panel=IN_AND_OUT,
            show_default="certificate.json",
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Grant a claim about a policy by an exact bound, or refuse it.

    The number of trials and their seed follow from claim and policy: to try
    again is the same try. Interrupted on a twin, it goes on where it stopped.
    Exit code 1 says that the claim is refused.
    """
    output = Output(as_json)
    output.say(f"Certifying {policy or 'the policy that ships with Equipoise'}")

    from equipoise.artefacts import partial_path
    from equipoise.studies import certification as study

    destination = choose_file(
        output,
        out,
        "certificate.json",
        policy,
        force=force,
        beside=lambda path: (study.evaluation_path(path),),
    )
    partial = partial_path(study.evaluation_path(destination.path))
    check_output(partial)
    claim = study.make_claim(probability, confidence, duration, world=world, trials=trials)
    table = read_policy(policy)
    output.rows(
        {
            "claimed": f"it {claim.words}",
            "takes": f"{claim.trials:,} trials, {claim.allowed:,} failures allowed",
        }
    )
    with trials_of(output, "certify", table, world, claim.trials) as done:
        certificate, evaluation = study.certify(
            table,
            claim,
            workers=available_workers(workers),
            partial=partial,
            done=done,
        )
    with destination.claimed() as out:
        beside = study.evaluation_path(out)
        inputs = {"policy": certificate.policy, "pendulum": evaluation.pendulum}
        evaluation.save(beside, command="certify", inputs=inputs)
        inputs = {"policy": certificate.policy, "evaluation": certificate.evaluation}
        certificate.save(out, command="certify", inputs=inputs)
    _say(output, certificate)
    output.wrote(out, beside)
    if certificate.granted:
        output.next("verify", out, *(("--policy", policy) if policy else ()))
    else:
        output.next(*next_step.after_evaluation(False, table, policy, world=world))
    output.result(
        {
            "granted": certificate.granted,
            "claim": claim.model_dump(mode="json"),
            "bound": certificate.bound,
            "trials": claim.trials,
            "failures": certificate.failed,
            "allowed": claim.allowed,
            "causes": certificate.failures,
            "seed": certificate.seed,
            "certificate": str(out),
            "evaluation": str(beside),
        }
    )
    if not certificate.granted:
        raise typer.Exit(REFUSED)


def _say(output: Output, certificate: "Certificate") -> None:
    from equipoise.studies.certification import percentage
    from equipoise.studies.formatting import falls

    claim = certificate.claim
    # Rounded down: a lower bound that is rounded up is none.
    bound = math.floor(1e5 * certificate.bound) / 1e5
    output.rows(
        {
            "outcome": f"{claim.trials - certificate.failed:,} of {claim.trials:,} lasted; "
            f"{falls(certificate.failures)}",
            "proves": f"a probability of at least {percentage(bound)}, at "
            f"{percentage(claim.confidence)} confidence",
            "seed": f"{certificate.seed}, from policy and claim: to try again is the same try",
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
