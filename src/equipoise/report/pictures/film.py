"""A run as moving pictures with its numbers below them, and as an animation that needs no player.

The report and the README show the animation: a WebP, which browsers play inside a page, and which
Pillow writes wherever matplotlib is installed.
"""

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.report.pictures.camera import Size
from equipoise.report.pictures.moments import Floats, moments, span
from equipoise.report.pictures.rendering import Picture, draw
from equipoise.report.pictures.scene import stage
from equipoise.report.style import GREY, INK

FRAME: Final[Size] = (480, 480)
"""Size of an animation."""
SECONDS: Final = 8.0
"""Length of an animation [s]: the paper's run and some more."""
FPS: Final = 12.5
"""Frames per second of an animation."""
HOLD: Final = 1.0
"""Time for which the last frame stands before the animation begins again [s]."""
QUALITY: Final = 60
"""Quality of an animation, 0 to 100."""
BAR: Final = 0.1
"""Share of the height for the numbers below the picture."""
COLUMNS: Final = (0.03, 0.25, 0.53, 0.73)
"""Where time, displacement, angle and command stand, as shares of the width."""


class Animation(NamedTuple):
    """A run as moving pictures, and its first frame for those who want no motion."""

    webp: bytes
    """The animation."""
    still: bytes
    """Its first frame, as a WebP."""


def animation(
    run: RunLog,
    arm: Arm,
    *,
    size: Size = FRAME,
    seconds: float = SECONDS,
    report: Callable[[float], None] = lambda _: None,
) -> Animation:
    """Draw the first seconds after the release as an animation at their real speed.

    Args:
        run: The run.
        arm: The arm that ran.
        size: Size of the frames.
        seconds: Length [s]; a shorter run is shown to its end.
        report: Called with the share of the frames that are done.

    Raises:
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig did not get as far as balancing.
        OutsideError: There is nothing to draw with.
    """
    from PIL import Image

    count = max(1, round(min(span(run)[1], seconds) * FPS))
    images: list[Image.Image] = []
    for picture in film(run, arm, np.arange(count) / FPS, size):
        images.append(Image.fromarray(picture))
        report(len(images) / count)
    pause = round(1e3 / FPS)
    durations = [pause] * (count - 1) + [round(1e3 * HOLD)]
    moving, still = io.BytesIO(), io.BytesIO()
    images[0].save(
        moving,
        "webp",
        save_all=True,
        append_images=images[1:],
        duration=durations,
        loop=0,
        quality=QUALITY,
        method=2,
    )
    images[0].save(still, "webp", quality=QUALITY)
    return Animation(moving.getvalue(), still.getvalue())


def film(run: RunLog, arm: Arm, times: Floats, size: Size) -> Iterator[Picture]:
    """Draw a run at `times` since the release [s], with its numbers below each picture.

    Raises:
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig did not get as far as balancing.
        OutsideError: There is nothing to draw with.
    """
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
    where = run.conditions.world
    captions = shown.captions()
    phases = shown.phase or ("",) * len(captions)
    pictures = draw(scene, shown.q, shown.phi, shown.u)
    for picture, lines, phase in zip(pictures, captions, phases, strict=True):
        image = Image.new("RGB", size, "white")
        image.paste(Image.fromarray(picture))
        pen = ImageDraw.Draw(image)
        for text, (column, row) in scene.labels():
            pen.text((column, row), text, INK, small, "mm")
        for place, line in zip(COLUMNS, lines, strict=True):
            pen.text((place * width, height - 0.72 * bar), line, INK, large, "lm")
        note = " · ".join(filter(None, (arm.name, where, phase)))
        pen.text((0.03 * width, height - 0.27 * bar), note, GREY, small, "lm")
        yield np.asarray(image)
