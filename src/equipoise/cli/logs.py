"""Verbs that read the log of a run: `equipoise log explain` and `log export`."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, command, verb
from equipoise.errors import InputError


@verb
def explain(output: Output, run: Path) -> None:
    """Explain why a run ended: causes with their evidence, the most likely first.

    Examines release, pushes, the encoder's zero, commands and safety rules,
    and gives advice. A truncated log is read as far as it is readable.
    """
    from equipoise.logs.run_log import RunLog
    from equipoise.outcomes import Outcome, describe
    from equipoise.rig.explanation import explain as why

    read = RunLog.load(run, damaged=True)
    causes, end = why(read), read.ending
    then = command("log show", run)
    if end.outcome is Outcome.EXCITED:
        then = command("identify", run, makes="actuator.json")
    output.result(
        warnings=[read.damage],
        outcome=end.outcome,
        reason=describe(end),
        phase=None if read.conditions.simulated else read.last_phase and read.last_phase.value,
        whole=read.end is not None,
        lasted_s=causes[0].time and read.lasted,
        cause=causes[0].cause,
        advice=causes[0].advice,
        causes={
            str(one.cause): {"score": one.score, "time_s": one.time, "evidence": one.evidence}
            for one in causes
        },
        then=then,
    )


class Film(Options):
    """The film."""

    video: Path | None = None
    """Write a film instead, .mp4 or .webp; with --out as well."""
    from_: float | None = None
    """Begin the film here [s], from the release on."""
    to: float | None = None
    """End the film here [s], from the release on."""


@verb
def export(output: Output, run: Path, *, film: Film, files: opt.Files) -> None:
    """Write each table of a run log as a CSV file, or film the run.

    Writes a folder, by default named as the log. Headers end in the unit:
    time_s, phi_rad. A truncated log is written as far as it is readable. The
    film of a run on a rig begins shortly before the release; --from and --to
    choose another part.
    """
    from equipoise.film import check_format, write_film
    from equipoise.logs.export import export
    from equipoise.logs.run_log import RunLog

    video, folder = film.video, None
    if video is None and (film.from_ is not None or film.to is not None):
        raise InputError("--from and --to choose the part of a film; give --video FILE as well")
    if video is not None:
        check_format(video.suffix.lower())
    log = RunLog.load(run, damaged=True)
    if files.out is not None or video is None:
        folder = files.folder(run.with_name(f"{run.stem}-csv"))
    if video is not None:
        suffix = video.suffix.lower()
        opt.Files(out=video, force=files.force).file("", run, suffix=suffix)
        with output.busy("drawing the film"):
            write_film(log, video, film.from_, film.to)
    output.result(
        run=run,
        tables=None if folder is None else export(log, folder),
        video=video,
        warnings=[log.damage],
        then=command("log explain", run),
    )
