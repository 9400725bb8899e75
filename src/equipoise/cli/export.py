"""`equipoise log export`: writes a run log as tables for other programs, or as a film."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from equipoise.cli import options as opt
from equipoise.cli.destinations import Destination, choose_file
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.model.arms.arm import Arm


@verb
def export(
    run: opt.RunFile,
    out: Annotated[
        Path | None,
        opt.out("Folder for the tables; by default named as the log.", False, "DIR"),
    ] = None,
    video: Annotated[
        Path | None,
        opt.value("FILE", "Write a film instead, MP4; with --out as well.", panel=opt.IN_AND_OUT),
    ] = None,
    force: opt.Force = False,
    as_json: opt.Json = False,
) -> None:
    """Write each table of a run log as a CSV file, or film the run.

    Headers end in the unit: time_s, phi_rad. A truncated log is written as far
    as it is readable. The film of a run on a rig begins shortly before the
    release.
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
        film = choose_film(output, video, run, force=force)
    if tables:
        folder = choose_file(output, out, run.with_name(f"{run.stem}-csv"), force=force, suffix="")
    made: list[Path] = []
    if folder is not None:
        with folder.claimed() as path:
            made += write(log, path)
    if film is not None:
        video = write_film(output, run, film)
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


def choose_film(output: Output, video: Path, *inputs: Path | None, force: bool) -> Destination:
    """Choose the name of a film, and check that films can be encoded here.

    Raises:
        InputError: The name cannot be used.
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    from equipoise.report.pictures import find_encoder

    film = choose_file(output, video, video, *inputs, force=force, suffix=".mp4", option="--video")
    find_encoder()
    return film


def write_film(output: Output, run: Path, film: Destination, arm: "Arm | None" = None) -> Path:
    """Film the run of a log, and return the name of the film.

    Args:
        output: Shows that the film is drawn.
        run: The log.
        film: Name that was chosen for the film.
        arm: Arm of the run; by default that of the log.

    Raises:
        InputError: Neither the caller nor the log describes the arm.
    """
    from equipoise.report.pictures import write_video
    from equipoise.studies.runs import arm_of, read_any

    log = read_any(run)
    arm = arm or arm_of(log)
    if arm is None:
        raise InputError(
            f"{run} does not describe its arm, which does not ship; repeat the run with equipoise "
            "deploy --video"
        )
    with film.claimed() as path, output.busy("drawing the film"):
        write_video(log, arm, path)
    return path
