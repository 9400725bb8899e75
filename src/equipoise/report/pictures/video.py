"""Video of a run in real time."""

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
"""Size of each frame; H.264 encoders need multiples of 16."""
FPS: Final = 30
"""Frames per second."""
QUALITY: Final = 7
"""Quality of the video, 1 to 10."""


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
    fps: int = FPS,
    report: Callable[[float], None] = lambda _: None,
) -> None:
    """Write a run as an MP4 (H.264) with time, displacement, angle and command.

    Args:
        run: The run; on a rig from shortly before the release until the arm is at rest.
        arm: The arm of the run.
        path: The file, written atomically.
        fps: Frames per second.
        report: Progress callback; receives the fraction of the frames that are done.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
        ArmError: The run is of another arm.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig ended before balancing.
        OutsideError: OpenGL is not available, or encoding or writing fails.
    """
    ffmpeg = find_encoder()
    begin, end = span(run)
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
