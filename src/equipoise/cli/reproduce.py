"""`equipoise reproduce`: reproduces the whole paper, from a free swing to a report."""

import time
from pathlib import Path

import typer

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output, trial_fields, verb

FOLDER = "equipoise-report"
"""Folder by default."""


@verb
def reproduce(
    context: typer.Context,
    quick: bool = opt.flag("--quick", "Fewer episodes and trials: under a minute."),
    recipe: str = opt.RECIPE,
    arm: str = opt.ARM,
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    swing: Path | None = opt.value(
        "CSV",
        "Recorded swing, as identify reads it; by default a simulated one.",
        panel=opt.RECORDING,
    ),
    start: float | None = opt.START,
    end: float | None = opt.END,
    counts_per_rev: int | None = opt.COUNTS_PER_REV,
    from_upright: bool = opt.FROM_UPRIGHT,
    columns: str | None = opt.COLUMNS,
    held: str | None = opt.HELD,
    base: str | None = opt.BASE,
    tip: str | None = opt.TIP,
    out: Path | None = opt.out("Folder for all files.", FOLDER, "DIR"),
    force: bool = opt.FORCE,
    settings_file: Path | None = opt.SETTINGS_FILE,
    settings: list[str] | None = opt.SET,
    as_json: bool = opt.JSON,
) -> None:
    """Reproduce the paper, from a free swing to a report.

    Identification, training, evaluation on the training plant and on the digital
    twin, and a run there. Writes every file to a folder, with a self-contained
    report in HTML.
    """
    output = Output(as_json)
    begin = time.perf_counter()
    output.say(f"Reproducing the paper{f' from {swing}' if swing else ''}")

    from equipoise.settings import resolve

    resolved = resolve(recipe, settings_file, settings or ())
    machine = opt.read_arm(arm, held, base, tip)
    recording = None
    if swing is None:
        taken = context.params.keys() - set(opt.SWING_OPTIONS)
        opt.only(context, "a simulated swing", *taken, hint="give a recording with --swing")
    else:
        from equipoise.identification.recording import read_swing

        recording = read_swing(swing, **opt.swing_options(context))
    destination = choose_file(output, out, FOLDER, force=force, suffix="")

    from equipoise.apps.report.page import build
    from equipoise.progress import StageProgress
    from equipoise.reproduction.pipeline import reproduce as run_pipeline
    from equipoise.reproduction.results import POLICY, verdict

    with destination.claimed() as folder, output.stages() as show:
        found = run_pipeline(
            folder,
            swing=recording,
            arm=machine,
            settings=resolved,
            seed=seed,
            quick=quick,
            workers=workers,
            report=show,
        )
        show(StageProgress("report"))
        page = build(folder, lambda name, share: show(StageProgress("report", share, text=name)))
    sentences = verdict(found)
    output.points(sentences)
    output.warn(found.policy.shortfall)
    output.wrote(page)
    output.next("evaluate", folder / POLICY, "--trials", "1000")
    trials = trial_fields(found.evaluation.results)
    output.result(
        out=folder,
        report=page,
        verdict=list(sentences),
        **trials,
        duration=found.evaluation.duration,
        world=found.run.conditions.world,
        lasted_s=found.run.lasted,
        outcome=found.run.outcome,
        wall_s=time.perf_counter() - begin,
        bad=trials["median_s"] < found.evaluation.duration,
    )
