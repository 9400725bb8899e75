"""The paper's figure 3: frames of one run."""

from itertools import takewhile
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise import paper
from equipoise.apps.report.pictures.camera import Size
from equipoise.apps.report.pictures.moments import moments, span
from equipoise.apps.report.pictures.rendering import ARROW_PER_U, draw
from equipoise.apps.report.pictures.scene import stage
from equipoise.apps.report.style import new_figure, styled
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.outcomes import Phase

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME: Final[Size] = (440, 440)
"""Size of each frame."""
COLUMNS: Final = 3
"""Number of frames per row."""
STEP: Final = 0.02
"""Time step of the candidates for frames [s]."""
MIN_INTERVAL: Final = 0.15
"""Minimum time between two frames [s]; closer frames look alike."""


@styled()
def strip(run: RunLog, arm: Arm) -> "Figure":
    """Draw frames of the extreme moments of a run, in chronological order.

    They are the release, the largest displacement and lean to either side, and the end. Each frame
    has a title, with its time, displacement, angle and command.

    Args:
        run: The run.
        arm: The arm of the run.

    Raises:
        ArmError: The run is of another arm.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig ended before balancing.
        OutsideError: OpenGL is not available.
    """
    chosen = key_moments(run, arm)
    shown, scene = moments(run, arm, list(chosen)), stage(arm, FRAME)
    rows = -(-len(chosen) // COLUMNS)
    figure = new_figure(0.75 + 2.8 * rows, "Frames of a run (the paper's figure 3)")
    panels: Any = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    captions = zip(chosen.values(), shown.captions(), strict=True)
    pictures = draw(scene, shown.q, shown.phi, shown.u)
    for panel, picture, (title, (time, x, phi, u)) in zip(panels, pictures, captions, strict=False):
        panel.imshow(picture)
        panel.set_title(f"{title}, {time}", loc="left", fontweight="bold")
        below = f"{x}  {phi}  {u}"
        panel.text(0.0, -0.02, below, transform=panel.transAxes, va="top", fontsize=7.0)
        for text, place in scene.labels():
            panel.text(*place, text, fontsize=6.5, ha="center", va="center")
    figure.supxlabel(
        "Drawn from the joint positions and angles of the run; +x is to the right. Posts: failure "
        f"at x = ±{paper.X_LIMIT:g} m, marks every 0.1 m;\nthe shadow of the pivot shows x. Thin "
        f"line: the upright. Arrow: u, {ARROW_PER_U:g} m for 1 m/s².",
        fontsize=8.0,
    )
    return figure


def key_moments(run: RunLog, arm: Arm) -> dict[float, str]:
    """Return the times of the extreme moments since the release [s], sorted, with their titles."""
    run.require_balancing()
    end = span(run)[1]
    all_moments = moments(run, arm, np.arange(0.0, end, STEP))
    # On a rig the arm comes to rest after balancing.
    on_rig = takewhile(lambda phase: phase == Phase.BALANCING.value, all_moments.phase)
    balancing = len(list(on_rig)) if all_moments.phase else len(all_moments.time)
    end = min(end, float(all_moments.time[balancing - 1]) + STEP)
    x, phi = all_moments.x[:balancing], all_moments.phi[:balancing]
    extremes = {
        "furthest left": np.argmin(x),
        "furthest right": np.argmax(x),
        "largest lean left": np.argmin(phi),
        "largest lean right": np.argmax(phi),
    }
    found = {0.0: "release", end: "end"}
    for title, row in extremes.items():
        time = float(all_moments.time[row])
        if all(abs(time - other) >= MIN_INTERVAL for other in found):
            found[time] = title
    return dict(sorted(found.items()))
