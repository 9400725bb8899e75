"""`equipoise card`: writes a policy card, in the form of a Hugging Face model card."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output, verb


@verb
def card(
    policy: Path = opt.argument("POLICY", "Table from equipoise train."),
    evidence: list[Path] | None = opt.argument(
        "EVIDENCE...", "Evaluations and certificates of this policy.", None
    ),
    name: str | None = opt.value("NAME", "Name on the card; by default that of the file."),
    out: Path | None = opt.out("Card to write, Markdown.", "POLICY-card.md"),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Write a policy card: what it is, where it stands, what it is not for.

    Markdown with the header of a Hugging Face model card. All figures are from
    the files; evidence of another policy is refused.
    """
    output = Output(as_json)
    output.say(f"Writing the card of {policy}")
    given = evidence or []
    destination = choose_file(
        output, out, f"{policy.stem}-card.md", policy, *given, force=force, suffix=".md"
    )

    from equipoise.artefacts import write_whole
    from equipoise.control.policy import TabularPolicy
    from equipoise.studies import card as study
    from equipoise.studies.verification import verify

    table = TabularPolicy.load(policy)
    output.warn(table.shortfall)
    found = [study.read_evidence(path, table) for path in given]
    origin = verify(policy).provenance
    text = study.card(table, origin, found, name=name or policy.stem, file=policy.name)
    with destination.claimed() as out:
        write_whole(out, text)
    output.wrote(out)
    if found:
        output.next("log", "verify", policy)
    else:
        output.next("evaluate", policy, "--claim", 0.99)
    output.result(card=out, policy=table.digest, evidence=[str(path) for path in given])
