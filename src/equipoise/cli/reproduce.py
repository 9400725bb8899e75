"""`equipoise reproduce`: reproduces the whole paper, from a free swing to a report."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, command, verb


class Extent(Options):
    """The reproduction."""

    quick: bool = False
    """Fewer episodes and trials: under a minute."""
    arm: str = "iiwa7"
    """{arms}, a URDF or a rig.toml."""
    swing: Path | None = None
    """Recorded swing, as identify reads it; by default a simulated one."""
    counts_per_rev: int | None = None
    """Encoder counts per revolution, after x4."""


@verb
def reproduce(
    output: Output,
    *,
    extent: Extent,
    changes: opt.Changes,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Reproduce the paper, from a free swing to a report.

    Identification; then training, evaluation and a run on the digital twin, for
    the literal recipe (paper) and the default one. Ends with a table of both
    beside the paper's robot. Writes every file to a folder (equipoise-report),
    with a self-contained report in HTML.
    """
    from equipoise.apps.report.page import build
    from equipoise.apps.report.rows import comparison
    from equipoise.identification.recording import read_swing
    from equipoise.learning.choice import with_digests
    from equipoise.reproduction.pipeline import reproduce
    from equipoise.reproduction.results import POLICY

    recorded = None
    if extent.swing is not None:
        recorded = read_swing(extent.swing, counts_per_rev=extent.counts_per_rev)
    arm, settings = opt.read_arm(extent.arm), changes.resolve()
    with_digests(settings.learning)
    out = files.folder(output, Path("equipoise-report"))
    with output.progress() as show:
        found = reproduce(
            out,
            swing=recorded,
            arm=arm,
            settings=settings,
            seed=random.seed,
            quick=extent.quick,
            workers=random.threads,
            report=show,
        )
        page = build(out, lambda name, share: show("report", share, name))
    evaluation = found.default.evaluation
    output.result(
        duration_s=evaluation.duration,
        report=page,
        comparison=comparison(found),
        warnings=[found.default.policy.shortfall],
        code=int(evaluation.results.summary().median < evaluation.duration),
        then=command("evaluate", out / POLICY, trials=1000),
    )
