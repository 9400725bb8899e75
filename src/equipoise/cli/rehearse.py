"""`equipoise rig rehearse`: injects faults on an emulated rig, and checks how each run ends."""

from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from equipoise.cli import options as opt
from equipoise.cli.output import Output, verb

if TYPE_CHECKING:
    from equipoise.studies.rehearsal import Result


@verb
def rehearse(
    policy: Path | None = opt.POLICY,
    rig: Path | None = opt.value("TOML", "Description of the rig."),
    only: list[str] | None = opt.value("NAME", "A fault, or a kind of faults; repeatable."),
    listed: bool = opt.flag("--list", "List the faults, and run none."),
    real_time: bool = opt.flag("--real-time", "Run those too that need real ports and processes."),
    workers: int | None = opt.value("N", "Processes; by default one per core.", min=1),
    as_json: bool = opt.JSON,
) -> None:
    """Inject each fault on an emulated rig, and check how the run ends.

    Each fault has a run of its own, from the first byte to rest. The bytes on
    the link and the true motion decide whether it ended as required. Exit
    code 1: one did not. With --rig, the rig's own arm is rehearsed.
    """
    output = Output(as_json)
    if not listed:
        output.say("Rehearsing on an emulated rig; a few minutes for all faults")

    from equipoise.control.policy import TabularPolicy, shipped_policy
    from equipoise.rigs import read_rig
    from equipoise.studies.rehearsal import Scenario, choose, rehearse_all

    if listed:
        faults = choose(only or ())
        for fault in faults:
            output.say(Text.assemble((fault.name, "bold"), f": {fault.injected}; {fault.should}"))
        output.result(faults=[fault.name for fault in faults])
        return
    table = shipped_policy() if policy is None else TabularPolicy.load(policy)
    scenario = Scenario(settings=read_rig(rig), policy=table)
    results: list[Result] = []
    with output.busy("preparing") as rename:
        for result in rehearse_all(
            only or (),
            scenario=scenario,
            real_time=real_time,
            workers=opt.available_workers(workers),
            begin=rename,
        ):
            results.append(result)
            _say(output, result)
    tried = [result for result in results if result.ran]
    bad = [result.name for result in tried if not result.good]
    left = len(results) - len(tried)
    words = f"{len(tried) - len(bad)} of {len(tried)} faults ended as required"
    output.say(f"{words}; {left} need --real-time" if left else words, style="red" if bad else None)
    if bad:
        output.next("rig", "rehearse", "--only", bad[0])
    elif left:
        output.next("rig", "rehearse", "--real-time")
    else:
        output.next("rig", "doctor")
    output.result(faults=[_fields(result) for result in results], failed=bad, bad=bool(bad))


def _say(output: Output, result: "Result") -> None:
    word, style = ("ok", "green") if result.good else ("failed", "bold red")
    if not result.ran:
        word, style = "-", "dim"
    output.say(Text.assemble((f"{word:<7}", style), (result.name, "bold"), f": {result.should}"))
    output.say(Text(f"       {result.did}", style="dim"))
    for problem in result.problems:
        output.say(Text(f"       {problem}", style="red"))


def _fields(result: "Result") -> dict[str, object]:
    fields = {name: getattr(result, name) for name in ("name", "kind", "injected", "should", "did")}
    return {**fields, "problems": list(result.problems), "tried": result.ran}
