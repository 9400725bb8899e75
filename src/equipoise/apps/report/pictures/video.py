"""Video of a run in real time: an MP4, or an animated WebP."""

import tempfile
from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from equipoise.apps.report.pictures.camera import Size
from equipoise.apps.report.pictures.film import animation, film
from equipoise.apps.report.pictures.moments import check_span
from equipoise.artefacts import write_whole
from equipoise.errors import MissingExtraError, OutsideError
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm

FRAME: Final[Size] = (960, 720)
"""Size of each frame; H.264 encoders need multiples of 16."""
FPS: Final = 30
"""Frames per second."""
QUALITY: Final = 7
"""Quality of the video, 1 to 10."""
MP4, WEBP = ".mp4", ".webp"
SUFFIXES: Final = (MP4, WEBP)
"""Suffixes of videos."""


def find_encoder() -> Any:  # the package has no types
    """Import the package that encodes videos.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    try:
        return import_module("imageio_ffmpeg")
    except ImportError:
        raise MissingExtraError("imageio-ffmpeg", "video") from None


def write_video(
    run: RunLog,
    arm: Arm,
    path: Path,
    *,
    begin: float | None = None,
    end: float | None = None,
    fps: int = FPS,
    report: Callable[[float], None] = lambda _: None,
) -> None:
    """Write a part of a run as a video with time, displacement, angle and command.

    The suffix of the file chooses between an MP4 (H.264) of 960 x 720, and an animated WebP of
    480 x 480 and 12.5 frames per second, which web pages play.

    Args:
        run: The run.
        arm: The arm of the run.
        path: The file, written atomically.
        begin: Start since the release [s]; by default the release, on a rig shortly before it.
        end: End since the release [s]; by default the end of the run.
        fps: Frames per second of an MP4.
        report: Progress callback; receives the fraction of the frames that are done.

    Raises:
        MissingExtraError: An MP4 needs imageio-ffmpeg, which is not installed.
        ArmError: The run is of another arm.
        InputError: The part is not one of the run, or too long for a WebP.
        RecordingError: No policy ran, or a run on a rig ended before its first tick.
        OutsideError: OpenGL is not available, or encoding or writing fails.
    """
    begin, end = check_span(run, begin, end)
    if path.suffix.lower() == WEBP:
        write_whole(path, animation(run, arm, begin=begin, end=end, report=report).webp)
        return
    ffmpeg = find_encoder()
    count = max(1, round((end - begin) * fps))
    pictures = film(run, arm, begin + np.arange(count) / fps, FRAME)
    pictures = chain([next(pictures)], pictures)  # drawing errors appear before encoding starts
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "run.mp4"
            kind: Any = {"codec": "libx264", "pix_fmt_out": "yuv420p", "quality": QUALITY}
            # Fast encoding, and playback during download.
            options: Any = ["-preset", "veryfast", "-movflags", "+faststart"]
            log: Any = {"ffmpeg_log_level": "error"}
            encoder = ffmpeg.write_frames(
                file, FRAME, fps=fps, output_params=options, **kind, **log
            )
            with closing(encoder):
                encoder.send(None)
                for done, picture in enumerate(pictures, 1):
                    encoder.send(picture)
                    report(done / count)
            # The encoder does not report errors; a full disk shows as missing frames.
            arrived, _ = ffmpeg.count_frames_and_secs(file)
            if arrived != count:
                raise OSError(f"{arrived} of {count} frames arrived, is the disk full?")
            write_whole(path, file.read_bytes())
    except OutsideError:  # OutsideError is an OSError; its message is complete
        raise
    except (OSError, RuntimeError) as error:
        raise OutsideError(f"cannot write {path}, the encoder failed: {error}") from None
