"""`equipoise refine`: identifies the model of a policy again, from the log of a run."""

from pathlib import Path
from typing import Any

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import command, verb


@verb
def refine(output: Output, policy: Path, run: Path, *, files: opt.Files) -> None:
    """Compare a run log with the model of a policy, and write what has changed.

    POLICY is the table that ran, RUN is a log from equipoise deploy.
    Identifies w2 and the actuator again, and writes those that left their
    intervals: the pendulum (refined.json), and the actuator beside it.
    """
    from equipoise.control.policy import TabularPolicy
    from equipoise.identification.refine import inspect
    from equipoise.logs.run_log import load_run
    from equipoise.model.actuator import shipped_actuator
    from equipoise.model.pendulum import shipped_pendulum

    table = TabularPolicy.load(policy)
    log = load_run(run)
    out = files.file(output, "refined.json", policy, run, beside=("-actuator.json",))
    output.warn(log.damage)
    with output.busy("identifying again"):
        findings = inspect(table, log)
    inputs = {"policy": table.digest, "run": log.digest}
    paths: dict[str, Any] = {}
    pendulum = opt.file_of(table.pendulum.digest, shipped_pendulum())
    actuator = opt.file_of(table.actuator.digest, shipped_actuator())
    if findings.pendulum.digest != table.pendulum.digest:
        paths["pendulum"] = pendulum = out
        findings.pendulum.save(out, command="refine", inputs=inputs)
    if findings.actuator.digest != table.actuator.digest:
        paths["actuator"] = actuator = out.with_name(out.stem + "-actuator.json")
        findings.actuator.save(actuator, command="refine", inputs=inputs)
    arm = opt.name_of(table.arm)
    then = command("train", pendulum, arm=arm, actuator=actuator)
    output.result(
        findings.fit,
        **findings.response,
        moved=list(findings.moves.values()) or ["nothing"],
        warnings=findings.warnings,
        **paths,
        then=then if paths else "",
    )
