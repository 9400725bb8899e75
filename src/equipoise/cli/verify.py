"""`equipoise log verify`: checks that a file of Equipoise is intact, and shows its content."""

from pathlib import Path
from typing import Any

from equipoise.cli import options as opt
from equipoise.cli.next_step import file_with
from equipoise.cli.output import Output, verb

FIELDS = ("what", "format", "version", "digest", "content")
"""Fields of the JSON object that are those of the file."""


@verb
def verify(
    file: Path = opt.argument(
        "FILE", "A run log, pendulum, actuator, policy, evaluation, certificate or reproduction."
    ),
    as_json: bool = opt.JSON,
) -> None:
    """Check that a file is intact, and show its content.

    Reads the whole file by the rules of its kind. Refuses a file that was
    edited, damaged or cut. A certificate is compared with the trials beside it.
    """
    output = Output(as_json)
    output.say(f"Reading {file}")

    from equipoise.studies.verification import verify as verify_file

    found = verify_file(file)
    history = found.provenance
    rows = {
        "is": f"an intact {found.what} ({found.format}, version {found.version})",
        "holds": found.content,
        **dict(found.lines),
    }
    if history is not None:
        software = history.software.get("equipoise", "unknown")
        rows["made"] = f"by {history.command} of Equipoise {software}, {history.created}"
    if found.digest is not None:
        rows["digest"] = f"matches, {found.digest[:19]}..."
    output.rows(rows)
    output.next(*_next(found.what, file))
    fields: dict[str, Any] = {name: getattr(found, name) for name in FIELDS}
    output.result(**fields, provenance=history and history.model_dump(mode="json"))


def _next(what: str, file: Path) -> tuple[object, ...]:
    """Return the command that takes a file of this kind."""
    if what == "certificate":
        from equipoise.studies.certification import Certificate

        policy = file_with(Certificate.load(file).policy, file)
        return ("evaluate", policy or "POLICY", "--verify", file)
    verbs = {"pendulum": ("train",), "actuator": ("train", "--actuator"), "policy": ("evaluate",)}
    if "log" in what:
        return ("log", "explain", file)
    return (*verbs[what], file) if what in verbs else ("reproduce",)
