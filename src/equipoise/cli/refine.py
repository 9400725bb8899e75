"""`equipoise refine`: compares a log with the model of a policy, and trains on if it moved."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, verb

if TYPE_CHECKING:
    from equipoise.artefacts import Artefact


class Retraining(Options):
    """Training."""

    train: bool = True
    """Train on where the model moved."""
    episodes: Annotated[int, Field(ge=1)] = 2000
    """Number of further episodes."""


@verb
def refine(
    output: Output,
    policy: Path,
    run: Path,
    *,
    retraining: Retraining,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Compare a log with the model of a policy, and train on if it moved.

    POLICY is the table that ran, RUN is a log from equipoise deploy.
    Identifies w2 and the actuator again. If one of them moved beyond its
    interval, training continues from the policy's table, and the better table
    is kept (refined.json), with pendulum and actuator beside it, if they moved.
    """
    parts = {"policy": ".json", "pendulum": "-pendulum.json", "actuator": "-actuator.json"}
    out = files.file("refined.json", policy, run, beside=list(parts.values())[1:])

    from equipoise.control.policy import TabularPolicy
    from equipoise.identification import refine as study
    from equipoise.logs.run_log import load_run

    table = TabularPolicy.load(policy)
    log = load_run(run)
    output.warn(log.damage)
    with output.busy("identifying again"):
        findings = study.inspect(table, log)
    made: dict[str, Artefact] = {}
    if findings.pendulum.digest != table.pendulum.digest:
        made["pendulum"] = findings.pendulum
    if findings.actuator.digest != table.actuator.digest:
        made["actuator"] = findings.actuator
    refinement = None
    if retraining.train and findings.moves:
        with output.progress() as show:
            refinement = study.retrain(
                table,
                findings.pendulum,
                findings.actuator,
                episodes=retraining.episodes,
                seed=random.seed,
                workers=random.threads,
                show=show,
            )
        made["policy"] = refinement.policy
        output.warn(refinement.policy.shortfall)
    inputs = {"policy": table.digest, "run": log.digest}
    paths: dict[str, Any] = {part: out.with_name(out.stem + parts[part]) for part in made}
    for part, path in paths.items():
        made[part].save(path, command="refine", inputs=inputs)
    tables = {} if refinement is None else {"old": refinement.old, "new": refinement.new}
    output.result(
        findings.fit,
        **findings.response,
        moved=list(findings.moves.values()) or ["nothing"],
        tables={
            name: {"survived": each.survived, "trials": each.trials, "score": each.score}
            for name, each in tables.items()
        },
        kept=refinement and refinement.kept,
        warnings=findings.warnings,
        **paths,
        then="evaluate POLICY",
    )
