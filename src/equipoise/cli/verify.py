"""`equipoise verify`: what is this file, and is it what was written?"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli.evaluate import trials_of
from equipoise.cli.next_step import file_with
from equipoise.cli.options import Json, Workers, available_workers
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.studies.certification import Certificate, Repetition

OTHER_OUTCOME = 1
"""Exit code where the trials of a certificate come out otherwise."""


@verb
def verify(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A pendulum, policy, evaluation, certificate, reproduction or run log.",
        ),
    ],
    policy: Annotated[
        Path | None,
        typer.Option(metavar="POLICY", help="What a certificate is about: repeat its trials."),
    ] = None,
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Check that a file is what Equipoise wrote, and say what it holds.

    With the policy of a certificate all its trials run again. Exit code 1 says
    that they come out otherwise.
    """
    output = Output(as_json)
    output.say(f"Reading {file}")

    from equipoise.studies.verification import verify as check

    found = check(file)
    if policy is not None and found.what != "certificate":
        raise InputError(f"{file} is a {found.what}, and --policy repeats a certificate")
    history = found.provenance
    rows = {
        "is": f"a sound {found.what} ({found.format}, version {found.version})",
        "holds": found.content,
    }
    if history is not None:
        software = history.software.get("equipoise", "unknown")
        rows["made"] = f"by {history.command} of Equipoise {software}, {history.created}"
    if found.digest is not None:
        rows["digest"] = f"matches, {found.digest[:19]}..."
    output.rows(rows)
    result: dict[str, object] = {
        "what": found.what,
        "format": found.format,
        "version": found.version,
        "digest": found.digest,
        "content": found.content,
        "provenance": history and history.model_dump(mode="json"),
    }
    if policy is None:
        output.next(*_next(found.what, file))
        output.result(result)
        return
    certificate, again = _repeat(output, file, policy, workers)
    _say(output, certificate, again)
    output.next("evaluate", policy, "--world", certificate.claim.world)
    output.result(result | {"repeated": _result(again)})
    if not again.same_outcome:
        raise typer.Exit(OTHER_OUTCOME)


def _next(what: str, file: Path) -> tuple[str, ...]:
    """Return what to do with a file."""
    if what == "certificate":
        from equipoise.studies.certification import Certificate

        about = Certificate.load(file).policy
        return ("verify", str(file), "--policy", str(file_with(about, file) or "POLICY"))
    verbs = {
        "pendulum": ("train",),
        "actuator": ("train", "--actuator"),
        "policy": ("evaluate",),
        "run log": ("explain",),
        "log of a run on a rig": ("explain",),
    }
    return (*verbs[what], str(file)) if what in verbs else ("reproduce",)


def _repeat(
    output: Output, file: Path, policy: Path, workers: int | None
) -> "tuple[Certificate, Repetition]":
    from equipoise.control.policy import TabularPolicy
    from equipoise.studies.certification import Certificate, repeat

    certificate, table = Certificate.load(file), TabularPolicy.load(policy)
    claim = certificate.claim
    with trials_of(output, "repeat", table, claim.world, claim.trials) as done:
        again = repeat(certificate, table, workers=available_workers(workers), done=done)
    return certificate, again


def _say(output: Output, certificate: "Certificate", again: "Repetition") -> None:
    from equipoise.studies.formatting import falls

    words = f"{certificate.claim.trials:,} trials again: {falls(again.failures)}"
    verdict = "granted" if again.granted else "refused"
    if not again.same_outcome:
        before = "granted" if certificate.granted else "refused"
        output.say(
            f"Not repeated: {words}, {verdict}; the certificate says "
            f"{falls(certificate.failures)}, {before}.",
            style="red",
        )
    elif again.same_trials:
        output.say(f"Repeated: {words}; each lasted as long as before, {verdict}.", style="green")
    else:
        output.say(
            f"Repeated: {words}; as many as before, {verdict}, but not each trial lasted as long: "
            "another processor or library rounds otherwise.",
            style="green",
        )


def _result(again: "Repetition") -> dict[str, object]:
    return {
        "granted": again.granted,
        "failures": sum(again.failures.values()),
        "causes": dict(again.failures),
        "same_outcome": again.same_outcome,
        "same_trials": again.same_trials,
    }
