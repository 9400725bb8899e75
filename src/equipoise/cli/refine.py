"""`equipoise refine`: compares logs with the model of a policy, and trains on if it moved."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output, in_ms, measured, verb, with_intervals
from equipoise.printable import printable

if TYPE_CHECKING:
    from equipoise.artefacts import Artefact, Estimate
    from equipoise.control.policy import Checkpoint, TabularPolicy
    from equipoise.identification.refine import Refinement, RefinementFindings

PARTS: tuple[str, ...] = ("policy", "pendulum", "actuator")
"""Files that may be written, and the keys of their paths in the JSON object."""


@verb
def refine(
    policy: Path = opt.argument("POLICY", "The policy that ran."),
    runs: list[Path] = opt.argument("RUN", "Logs from equipoise deploy."),
    training: bool = opt.flag(
        "--train/--no-train", "Train on where the model moved.", default=True
    ),
    always: bool = opt.flag("--always", "Train on even where nothing moved."),
    episodes: int | None = opt.value("N", "Number of further episodes; by default 2,000.", min=1),
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    out: Path | None = opt.out(
        "Policy to write; pendulum and actuator beside it, if they moved.", "refined.json"
    ),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Compare logs with the model of a policy, and train on if it moved.

    Identifies w2, c and the actuator again. If one of them moved beyond its
    interval, training continues from the policy's table, and the better table
    is kept.
    """
    output = Output(as_json)
    output.say(f"Comparing {policy} with {', '.join(map(str, runs))}")
    destination = choose_file(
        output, out, "refined.json", policy, *runs, force=force, beside=_beside
    )

    from equipoise.control.policy import TabularPolicy
    from equipoise.identification.refine import inspect
    from equipoise.logs.runs import load_run

    table = TabularPolicy.load(policy)
    logs = {str(path): load_run(path) for path in runs}
    for path, log in logs.items():
        if missing := log.damage:
            output.warn(f"{path}: {missing}")
    with output.busy("identifying again"):
        findings = inspect(table, logs)
    _say(output, table, findings)

    made: dict[str, Artefact] = {}
    if findings.pendulum.digest != table.pendulum.digest:
        made["pendulum"] = findings.pendulum
    if findings.actuator.digest != table.actuator.digest:
        made["actuator"] = findings.actuator
    refinement = None
    if training and (findings.moves or always):
        refinement = _retrain(output, table, findings, episodes, seed, workers)
        made["policy"] = refinement.policy
        old, new = _lasted(refinement.old), _lasted(refinement.new)
        output.rows({"old table": old, "new table": new})
        output.say(f"The {refinement.kept} table is kept, with the new model.")
        output.warn(refinement.policy.shortfall)
    inputs = {"policy": table.digest}
    inputs |= {printable(name): log.digest for name, log in logs.items()}
    with destination.claimed() as out:
        paths = dict(zip(PARTS, (out, *_beside(out)), strict=True))
        for part, artefact in made.items():
            artefact.save(paths[part], command="refine", inputs=inputs)
    if made:
        output.wrote(*(paths[part] for part in made))
    output.next(*(("evaluate", out) if refinement else ("deploy", policy)))
    written: dict[str, Any] = {part: paths[part] if part in made else None for part in PARTS}
    output.result(**_result(findings, refinement), **written)


def _beside(out: Path) -> tuple[Path, ...]:
    return tuple(out.with_name(f"{out.stem}-{part}.json") for part in PARTS[1:])


def _retrain(
    output: Output,
    policy: "TabularPolicy",
    findings: "RefinementFindings",
    episodes: int | None,
    seed: int,
    workers: int | None,
) -> "Refinement":
    from equipoise.identification import refine as study
    from equipoise.progress import StageProgress, TrainingProgress, compile_training, compiling

    settings = study.settings_of_retraining(policy.settings, episodes or study.EPISODES)
    with output.stages() as show:
        with compiling(show):
            compile_training(policy.arm, settings)
        progress = TrainingProgress(settings, show)

        def trials(stage: str, done: int, of: int) -> None:
            show(StageProgress(stage, done, of, "trials"))

        return study.retrain(
            policy,
            findings.pendulum,
            findings.actuator,
            episodes=settings.learning.episodes,
            seed=seed,
            workers=opt.available_workers(workers),
            comparing=functools.partial(trials, "compare"),
            testing=functools.partial(trials, "test"),
            observer=progress,
        )


def _say(output: Output, policy: "TabularPolicy", findings: "RefinementFindings") -> None:
    from equipoise.identification.refine import numbers

    fit, known = findings.fit, policy.pendulum
    rows = {
        "logs": f"{fit.duration:.1f} s, {fit.samples:,} encoder counts",
        "w2 = m g l / I": f"{measured(fit.w2, '1/s^2')}; was {known.w2.value:.4g}",
        "c = b / I": f"{measured(fit.c, '1/s')}; was {known.c.value:.3g}",
        "Coulomb / I": f"{measured(fit.coulomb, '1/s^2')}; was {known.coulomb.value:.3g}",
    }
    before = numbers(policy.actuator, policy.arm)
    for name, now in findings.response.items():
        rows[name] = f"{in_ms(now)}; was {1e3 * before[name].value:.3g}"
    output.rows(rows)
    output.warn(*findings.warnings)
    if findings.moves:
        output.points(move.text for move in findings.moves)
    else:
        output.say(
            "The model still holds: nothing moved beyond its interval and what training varies.",
            style="green",
        )


def _lasted(candidate: "Checkpoint") -> str:
    return (
        f"{candidate.survived} of {candidate.trials} trials on the new model lasted, "
        f"score {candidate.score:.4f}"
    )


def _result(findings: "RefinementFindings", refinement: "Refinement | None") -> dict[str, Any]:
    fit = findings.fit
    estimates: dict[str, Estimate] = {
        name: getattr(fit, name).not_negative() for name in ("w2", "k", "c", "coulomb", "friction")
    }
    estimates |= {name.replace(" ", "_"): now for name, now in findings.response.items()}
    result = {"moved": [move.name for move in findings.moves], **with_intervals(estimates)}
    tables = {} if refinement is None else {"old": refinement.old, "new": refinement.new}
    return result | {
        "kept": refinement and refinement.kept,
        "survival": {table: each.survived / each.trials for table, each in tables.items()},
        "score": {table: each.score for table, each in tables.items()},
        "warnings": list(findings.warnings),
    }
