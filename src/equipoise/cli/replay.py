"""`equipoise log replay`: does the controller do again what a log says?"""

from pathlib import Path
from typing import Annotated

import typer

from equipoise.cli.options import Json, KnownActuator, RunFile, read_actuator, read_policy
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

OTHERWISE = 1
"""Exit code where it does not."""


@verb
def replay(
    run: RunFile,
    policy: Annotated[
        Path | None,
        typer.Argument(
            metavar="POLICY",
            help="The policy that ran; without it, the one that ships.",
            show_default=False,
        ),
    ] = None,
    actuator: KnownActuator = None,
    tolerance: Annotated[
        float,
        typer.Option(metavar="SI", help="Numbers may differ by so much; 0 asks for every bit."),
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Feed the measurements of a log through the controller again, and compare.

    All that a tick was told is in the log of a run on a rig: setpoints and
    states come out again, bit for bit on the machine that made it. Exit code 1
    says that they do not, and where first.
    """
    output = Output(as_json)
    if not tolerance >= 0.0:
        raise InputError(f"--tolerance is {tolerance:g}; give 0 or more")
    output.say(f"Replaying {run}")

    from equipoise.studies.replay import replay as again
    from equipoise.studies.runs import missing_part, read_any

    log = read_any(run)
    with output.busy("replaying"):
        found = again(log, read_policy(policy), read_actuator(actuator), tolerance=tolerance)
    if missing := missing_part(log):
        output.warn(missing)
    first = found.difference
    if first is None:
        same = "bit for bit" if found.largest == 0.0 else f"within {found.largest:.1g}"
        output.say(f"The same: {found.ticks:,} ticks, {same}.", style="green")
    else:
        output.say(
            f"Otherwise: {found.ticks:,} ticks are the same; in the next, at {first.time:.3f} s, "
            f"{first.what} is {first.replayed!r}, and the log says {first.logged!r}.",
            style="red",
        )
    output.next("log", "explain", run)
    output.result(
        {
            "run": str(run),
            "same": first is None,
            "ticks": found.ticks,
            "whole": found.whole,
            "largest": found.largest,
            "difference": None
            if first is None
            else {
                "tick": first.tick,
                "time_s": first.time,
                "what": first.what,
                "logged": repr(first.logged),
                "replayed": repr(first.replayed),
            },
        }
    )
    if first is not None:
        raise typer.Exit(OTHERWISE)
