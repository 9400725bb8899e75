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

    from equipoise.apps.report.page import build
    from equipoise.identification.recording import read_swing
    from equipoise.progress import StageProgress
    from equipoise.reproduction.pipeline import reproduce

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
        show(StageProgress("report"))
        page = build(out, lambda name, share: show(StageProgress("report", share, text=name)))
    trials = trial_fields(found.evaluation.results)
    output.result(
        **trials,
        duration_s=found.evaluation.duration,
        world=found.run.conditions.world,
        lasted_s=found.run.lasted,
        outcome=found.run.outcome,
        wall_s=time.perf_counter() - begin,
        report=page,
        warnings=[found.policy.shortfall],
        code=int(trials["median_s"] < found.evaluation.duration),
        then="evaluate POLICY --trials 1000",
    )
