"""`equipoise rig rehearse`: everything goes wrong, and ends as it should."""

from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from equipoise.cli.options import Json
from equipoise.cli.output import Output, verb

if TYPE_CHECKING:
    from equipoise.studies.rehearsal import Result

ENDED_OTHERWISE = 1
"""Exit code where a fault did not end as it should."""


@verb
def rehearse(
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A fault or a kind of them; may be given again."),
    ] = None,
    listed: Annotated[
        bool, typer.Option("--list", help="Say what there is, and try nothing.")
    ] = False,
    real_time: Annotated[
        bool,
        typer.Option("--real-time", help="Try those too that need real ports and processes."),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Processes; by default one per core."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Let everything go wrong on an emulated rig, and see how it ends.

    Each fault has a run of its own, from the first byte to rest. What was sent
    and what really moved says whether it ended as it should. Exit code 1 says
    that one did not.
    """
    output = Output(as_json)
    if not listed:
        output.say("Rehearsing on an emulated rig; a few minutes for all faults")

    from equipoise.studies.rehearsal import choose, rehearse_all

    if listed:
        virtual, live = choose(only or ())
        faults = [*virtual, *live]
        for fault in faults:
            output.say(Text.assemble((fault.name, "bold"), f": {fault.injected}; {fault.should}"))
        output.result({"faults": [fault.name for fault in faults]})
        return
    results: list[Result] = []
    from equipoise.cli.options import available_workers

    with output.busy("preparing") as rename:
        for result in rehearse_all(
            only or (), real_time=real_time, workers=available_workers(workers), begin=rename
        ):
            results.append(result)
            _say(output, result)
    tried = [result for result in results if result.ran]
    bad = [result.name for result in tried if not result.good]
    left = len(results) - len(tried)
    words = f"{len(tried) - len(bad)} of {len(tried)} faults ended as they should"
    output.say(f"{words}; {left} need --real-time" if left else words, style="red" if bad else None)
    if bad:
        output.next("rig", "rehearse", "--only", bad[0])
    elif left:
        output.next("rig", "rehearse", "--real-time")
    else:
        output.next("rig", "doctor")
    output.result({"faults": [_plain(result) for result in results], "failed": bad})
    if bad:
        raise typer.Exit(ENDED_OTHERWISE)


def _say(output: Output, result: "Result") -> None:
    word, style = ("ok", "green") if result.good else ("failed", "bold red")
    if not result.ran:
        word, style = "-", "dim"
    output.say(Text.assemble((f"{word:<7}", style), (result.name, "bold"), f": {result.should}"))
    output.say(Text(f"       {result.did}", style="dim"))
    for problem in result.problems:
        output.say(Text(f"       {problem}", style="red"))


def _plain(result: "Result") -> dict[str, object]:
    return {
        "name": result.name,
        "kind": result.kind,
        "injected": result.injected,
        "should": result.should,
        "did": result.did,
        "problems": list(result.problems),
        "tried": result.ran,
    }
