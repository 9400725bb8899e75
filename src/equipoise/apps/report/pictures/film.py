"""Captioned frames of a run, and an animation made from them.

The report and the README show the animation: a WebP, which browsers play inside a page. Pillow, a
dependency of matplotlib, writes it.
"""

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from equipoise.apps.report.pictures.camera import Size
from equipoise.apps.report.pictures.moments import Floats, check_span, moments, span
from equipoise.apps.report.pictures.rendering import Picture, draw
from equipoise.apps.report.pictures.scene import stage
from equipoise.apps.report.style import GREY, INK
from equipoise.errors import InputError
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm

FRAME: Final[Size] = (480, 480)
"""Size of an animation."""
SECONDS: Final = 8.0
"""Usual length of an animation [s]; the paper's run took 5 s."""
MAX_SECONDS: Final = 30.0
"""Maximum length of an animation [s]; the encoder holds all frames in memory, 0.7 MB each."""
FPS: Final = 12.5
"""Frames per second of an animation."""
HOLD: Final = 1.0
"""Duration of the last frame before the animation restarts [s]."""
QUALITY: Final = 60
"""WebP quality of an animation, 0 to 100."""
BAR: Final = 0.1
"""Height of the captions below the picture, as a share of the height."""
COLUMNS: Final = (0.03, 0.25, 0.53, 0.73)
"""Positions of time, displacement, angle and command, as shares of the width."""


class Animation(NamedTuple):
    """Animation of a run, and a still for browsers set to reduced motion."""

    webp: bytes
    """The animation."""
    still: bytes
    """The first frame, as a WebP."""


def animation(
    run: RunLog,
    arm: Arm,
    *,
    size: Size = FRAME,
    begin: float = 0.0,
    end: float | None = None,
    report: Callable[[float], None] = lambda _: None,
) -> Animation:
    """Draw a part of a run as an animation in real time.

    Args:
        run: The run.
        arm: The arm of the run.
        size: Size of the frames.
        begin: Start since the release [s].
        end: End [s]; by default that of the run, or eight seconds after the start.
        report: Progress callback; receives the fraction of the frames that are done.

    Raises:
        ArmError: The run is of another arm.
        InputError: The part is not one of the run, or longer than 30 s.
        RecordingError: No policy ran, or a run on a rig ended before its first tick.
        OutsideError: OpenGL is not available.
    """
    from PIL import Image

    begin, end = check_span(run, begin, min(span(run)[1], begin + SECONDS) if end is None else end)
    check_length(end - begin)
    count = max(1, round((end - begin) * FPS))
    images: list[Image.Image] = []
    for picture in film(run, arm, begin + np.arange(count) / FPS, size):
        images.append(Image.fromarray(picture))
        report(len(images) / count)
    durations = [round(1e3 / FPS)] * (count - 1) + [round(1e3 * HOLD)]
    moving, still = io.BytesIO(), io.BytesIO()
    loop: Any = {"save_all": True, "append_images": images[1:], "duration": durations, "loop": 0}
    images[0].save(moving, "webp", quality=QUALITY, method=2, **loop)
    images[0].save(still, "webp", quality=QUALITY)
    return Animation(moving.getvalue(), still.getvalue())


def check_length(seconds: float) -> None:
    """Check that an animation can be as long [s].

    Raises:
        InputError: It is longer than 30 s.
    """
    if seconds > MAX_SECONDS:
        raise InputError(
            f"an animated WebP of {seconds:g} s is too large, expected {MAX_SECONDS:g} s or less; "
            "choose a shorter part, or an MP4"
        )


def film(run: RunLog, arm: Arm, times: Floats, size: Size) -> Iterator[Picture]:
    """Draw a run at `times` since the release [s], with captions; raise as `animation` does."""
    from matplotlib import get_data_path
    from PIL import Image, ImageDraw, ImageFont

    width, height = size
    bar = round(BAR * height)
    shown, scene = moments(run, arm, times), stage(arm, (width, height - bar))
    fonts, unit = Path(get_data_path(), "fonts", "ttf"), min(bar, width // 10)
    large, small = (
        ImageFont.truetype(fonts / name, round(share * unit))
        for name, share in (("DejaVuSans-Bold.ttf", 0.3), ("DejaVuSans.ttf", 0.27))
    )
    phases = shown.phase or ("",) * len(times)
    pictures = draw(scene, shown.q, np.nan_to_num(shown.phi, nan=np.pi), shown.u)
    for picture, lines, phase in zip(pictures, shown.captions(), phases, strict=True):
        image = Image.new("RGB", size, "white")
        image.paste(Image.fromarray(picture))
        pen = ImageDraw.Draw(image)
        for text, (column, row) in scene.labels():
            pen.text((column, row), text, INK, small, "mm")
        for place, line in zip(COLUMNS, lines, strict=True):
            pen.text((place * width, height - 0.72 * bar), line, INK, large, "lm")
        note = " · ".join(filter(None, (arm.name, run.conditions.world, phase)))
        pen.text((0.03 * width, height - 0.27 * bar), note, GREY, small, "lm")
        yield np.asarray(image)
