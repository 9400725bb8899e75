"""`equipoise log export`: writes a run log as tables for other programs, or as a film."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.destinations import Destination, choose_file
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError


@verb
def export(
    run: Path = opt.RUN,
    out: Path | None = opt.out("Folder for the tables; by default named as the log.", False, "DIR"),
    video: Path | None = opt.value(
        "FILE",
        "Write a film instead, .mp4 or .webp; with --out as well.",
        panel=opt.IN_AND_OUT,
    ),
    begin: float | None = opt.value(
        "SECONDS", "Begin the film here, from the release on.", "--from", panel=opt.IN_AND_OUT
    ),
    end: float | None = opt.value(
        "SECONDS", "End the film here, from the release on.", "--to", panel=opt.IN_AND_OUT
    ),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Write each table of a run log as a CSV file, or film the run.

    Headers end in the unit: time_s, phi_rad. A truncated log is written as far
    as it is readable. The film of a run on a rig begins shortly before the
    release; --from and --to choose another part.
    """
    output = Output(as_json)
    tables = out is not None or video is None
    what = " and ".join((["the tables"] if tables else []) + (["a film"] if video else []))
    output.say(f"Writing {what} of {run}")

    from equipoise.film import film_times
    from equipoise.logs.run_log import RunLog
    from equipoise.logs.runs import export as write

    log = RunLog.load(run, damaged=True)
    output.warn(log.damage)
    if video is None and (begin is not None or end is not None):
        raise InputError("--from and --to choose the part of a film; give --video FILE as well")
    film = None
    if video is not None:
        film = choose_film(output, video, run, force=force)
        film_times(log, video.suffix.lower(), begin, end)
    folder = None
    if tables:
        folder = choose_file(output, out, run.with_name(f"{run.stem}-csv"), force=force, suffix="")
    made: list[Path] = []
    if folder is not None:
        with folder.claimed() as path:
            made += write(log, path)
    if film is not None:
        video = draw_film(output, run, film, begin, end)
    output.wrote(*made, *([video] if video else []))
    output.next("log", "explain", run)
    output.result(
        run=run,
        tables=made,
        video=video,
        whole=not log.damage,
    )


def choose_film(output: Output, video: Path, *inputs: Path | None, force: bool) -> Destination:
    """Choose the name of a film, and check that such films can be written."""
    from equipoise.film import check_format

    suffix = video.suffix.lower()
    check_format(suffix)
    return choose_file(output, video, video, *inputs, force=force, suffix=suffix, option="--video")


def draw_film(
    output: Output,
    run: Path,
    film: Destination,
    begin: float | None = None,
    end: float | None = None,
) -> Path:
    """Film the run of a log, and return the name of the film.

    Args:
        output: Shows that the film is drawn.
        run: The log.
        film: Name that was chosen for the film.
        begin: Start since the release [s]; by default as `write_film` has it.
        end: End since the release [s].
    """
    from equipoise.film import write_film
    from equipoise.logs.run_log import RunLog

    log = RunLog.load(run, damaged=True)
    with film.claimed() as path, output.busy("drawing the film") as rename:

        def show(share: float) -> None:
            rename(f"drawing the film, {share:.0%}")

        write_film(log, path, begin, end, show)
    return path
