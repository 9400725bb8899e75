"""`equipoise verify`: what is this file, and is it what was written?"""

from pathlib import Path
from typing import Annotated

import typer

from equipoise.cli.options import Json
from equipoise.cli.output import Output, verb


@verb
def verify(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="A pendulum, policy, evaluation, reproduction or run log."
        ),
    ],
    as_json: Json = False,
) -> None:
    """Check that a file is what Equipoise wrote, and say what it holds."""
    output = Output(as_json)
    output.say(f"Reading {file}")

    from equipoise.studies.verification import verify as check

    found = check(file)
    history = found.provenance
    output.rows(
        {
            "is": f"a sound {found.what} ({found.format}, version {found.version})",
            "holds": found.content,
            "made": f"by {history.command} of Equipoise "
            f"{history.software.get('equipoise', 'unknown')}, {history.created}",
            "digest": f"matches, {found.digest[:19]}...",
        }
    )
    output.next(*_NEXT.get(found.what, ("reproduce",)), *([file] if found.what in _NEXT else []))
    output.result(
        {
            "what": found.what,
            "format": found.format,
            "version": found.version,
            "digest": found.digest,
            "content": found.content,
            "provenance": history.model_dump(mode="json"),
        }
    )


_NEXT = {"pendulum": ("train",), "policy": ("evaluate",)}
"""What to do with a file."""
