"""`equipoise reproduce`: reproduces the whole paper, from a free swing to a report."""

import time
from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.evaluate import trial_fields
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, verb
from equipoise.errors import InputError


class Extent(Options):
    """The reproduction."""

    quick: bool = False
    """Fewer episodes and trials: under a minute."""
    arm: str = "iiwa7"
    """iiwa7, iiwa14, another registered arm, a URDF or a rig.toml."""
    swing: Path | None = None
    """Recorded swing, as identify reads it; by default a simulated one."""


@verb
def reproduce(
    output: Output,
    *,
    extent: Extent,
    changes: opt.Changes,
    reading: opt.Swing,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Reproduce the paper, from a free swing to a report.

    Identification, training, evaluation and a run on the digital twin. Writes
    every file to a folder (equipoise-report), with a self-contained report in
    HTML.
    """
    out = files.folder(Path("equipoise-report"))
    if extent.swing is None and reading != opt.Swing():
        raise InputError("options of a recording need one; give it with --swing")
    begin = time.perf_counter()

    from equipoise.apps.report.page import PAGE, build
    from equipoise.studies.progress import ProgressReporter
    from equipoise.studies.reproduction import discard, reproduce
    from equipoise.trajectory import read_swing

    discard(out)
    with output.progress() as show:
        found = reproduce(
            out,
            swing=None if extent.swing is None else read_swing(extent.swing, **dict(reading)),
            arm=opt.read_arm(extent.arm),
            settings=changes.resolve(),
            seed=random.seed,
            quick=extent.quick,
            workers=random.threads,
            report=show,
        )
        build(out, lambda name, share: show(ProgressReporter("report", share, text=name)))
    evaluation, run = found.results.evaluation, found.results.run
    trials = trial_fields(evaluation.results)
    output.result(
        verdict=list(found.verdict),
        **trials,
        duration_s=evaluation.duration,
        world=run.conditions.world,
        lasted_s=run.lasted,
        cause=run.cause,
        wall_s=time.perf_counter() - begin,
        report=out / PAGE,
        warnings=[found.results.policy.shortfall],
        code=int(trials["median_s"] < evaluation.duration),
        then="evaluate POLICY --trials 1000",
    )
