"""`equipoise log export`: a run log becomes tables that any program reads, or a film."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli.destinations import choose_file, choose_folder
from equipoise.cli.options import IN_AND_OUT, Force, Json, RunFile
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.runlog import RunLog
    from equipoise.runwriter import RigRun


@verb
def export(
    run: RunFile,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the tables; by default named as the log.",
            rich_help_panel=IN_AND_OUT,
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A film instead, MP4; with --out as well.",
            rich_help_panel=IN_AND_OUT,
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write each table of a run log as a CSV file, or film the run.

    Headers end in the unit: time_s, phi_rad. A log that breaks off is
    written as far as it goes. The film of a run on a rig begins shortly before
    the release.
    """
    output = Output(as_json)
    tables = out is not None or video is None
    what = " and ".join((["the tables"] if tables else []) + (["a film"] if video else []))
    output.say(f"Writing {what} of {run}")

    from equipoise.studies.runs import export as write
    from equipoise.studies.runs import missing_part, read_any

    log = read_any(run)
    if missing := missing_part(log):
        output.warn(missing)
    film = folder = None
    if video is not None:
        film = choose_file(output, video, video, run, force=force, suffix=".mp4", option="--video")
        find_encoder()
    if tables:
        folder = choose_folder(output, out, run.with_name(f"{run.stem}-csv"), force=force)
    made: list[Path] = []
    if folder is not None:
        with folder.claimed() as path:
            made += write(log, path)
    if film is not None:
        with film.claimed() as video:
            _film(output, log, run, video)
    output.wrote(*made, *([video] if video else []))
    output.next("log", "explain", run)
    output.result(
        {
            "run": str(run),
            "tables": [str(path) for path in made],
            "video": str(video) if video else None,
            "whole": not missing,
        }
    )


def _film(output: Output, log: "RunLog | RigRun", run: Path, video: Path) -> None:
    from equipoise.report.pictures import write_video
    from equipoise.studies.runs import arm_of

    arm = arm_of(log)
    if arm is None:
        raise InputError(
            f"{run} does not describe its arm, which is none that ships; "
            "repeat the run with equipoise deploy --video"
        )
    with output.busy("drawing the film"):
        write_video(log, arm, video)
