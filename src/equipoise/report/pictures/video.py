"""A run as a video, at the speed at which it happened."""

import tempfile
from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from equipoise.artefacts import write_whole
from equipoise.errors import MissingExtraError, OutsideError
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.report.pictures.camera import Size
from equipoise.report.pictures.film import film
from equipoise.report.pictures.moments import span

FRAME: Final[Size] = (960, 720)
"""Of each frame; multiples of 16, as encoders want them."""
FPS: Final = 30
"""Frames per second."""
QUALITY: Final = 7
"""From 1 to 10."""


def find_encoder() -> Any:  # the package has no types
    """Return the package that encodes videos.

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
    fps: int = FPS,
    report: Callable[[float], None] = lambda _: None,
) -> None:
    """Write a run as an MP4 (H.264) with time, displacement, angle and command.

    Args:
        run: The run; of one on a rig, from shortly before the release until the arm rests.
        arm: The arm that ran.
        path: The file, written whole or not at all.
        fps: Frames per second.
        report: Called with the share of the frames that are done.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig did not get as far as balancing.
        OutsideError: There is nothing to draw with, or the disk or the encoder refuses.
    """
    ffmpeg = find_encoder()
    begin, end = span(run)
    count = max(1, round((end - begin) * fps))
    pictures = film(run, arm, begin + np.arange(count) / fps, FRAME)
    pictures = chain([next(pictures)], pictures)  # it can be drawn, before the encoder begins
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "run.mp4"
            encoder = ffmpeg.write_frames(
                file,
                FRAME,
                fps=fps,
                codec="libx264",
                pix_fmt_out="yuv420p",
                quality=QUALITY,
                ffmpeg_log_level="error",
                # Quick to encode, and it plays while it loads.
                output_params=["-preset", "veryfast", "-movflags", "+faststart"],
            )
            with closing(encoder):
                encoder.send(None)
                for done, picture in enumerate(pictures, 1):
                    encoder.send(picture)
                    report(done / count)
            # How the encoder ended is not told: a full disk shows in the frames that are missing.
            arrived, _ = ffmpeg.count_frames_and_secs(file)
            if arrived != count:
                raise OSError(f"{arrived} of {count} frames arrived, is the disk full?")
            write_whole(path, file.read_bytes())
    except OutsideError:  # ours say enough
        raise
    except (OSError, RuntimeError) as error:
        raise OutsideError(f"cannot write {path}, the encoder failed: {error}") from None
