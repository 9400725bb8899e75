"""The paper's figure 3: frames of one run."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise import paper
from equipoise.model.arms.arm import Arm
from equipoise.report.pictures.camera import Size
from equipoise.report.pictures.moments import moments, span
from equipoise.report.pictures.rendering import draw
from equipoise.report.pictures.stage import stage
from equipoise.report.style import drawn, new_figure
from equipoise.runlog import RunLog
from equipoise.runwriter import RigRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME: Final[Size] = (420, 460)
"""Of each frame."""
COLUMNS: Final = 4
"""Frames side by side."""
COUNT: Final = 8
"""Frames, where no times are given."""


@drawn
def strip(run: RunLog | RigRun, arm: Arm, times: Sequence[float] | None = None) -> "Figure":
    """Draw frames of a run in the order of time, each with its time, displacement and angle.

    Args:
        run: The run.
        arm: The arm that ran.
        times: Moments to show [s]; evenly over the first seconds, as many as the paper's run
            lasted, if not given.

    Raises:
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig did not get as far as balancing.
        OutsideError: There is nothing to draw with.
    """
    if times is None:
        at = np.linspace(0.0, min(span(run)[1], paper.SECONDS_BALANCED), COUNT)
    else:
        at = np.array(times, np.float64)
    shown, scene = moments(run, arm, at), stage(arm, FRAME)
    rows = -(-len(at) // COLUMNS)
    figure = new_figure(0.75 + 2.35 * rows, "Frames of a run (the paper's figure 3)")
    panels: Any = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for panel, picture, (time, x, phi) in zip(
        panels, draw(scene, shown.q, shown.phi), shown.captions(), strict=False
    ):
        panel.imshow(picture)
        panel.set_title(time, loc="left", fontweight="bold")
        panel.text(0.0, -0.02, f"{x}   {phi}", transform=panel.transAxes, va="top", fontsize=7.5)
    limit = paper.X_LIMIT
    figure.supxlabel(
        "Drawn from the joint positions and angles of the run, seen from the front: +x is on the "
        f"left.\nPosts: failure at x = ±{limit:g} m. Thin line: the upright.",
        fontsize=8.0,
    )
    return figure
