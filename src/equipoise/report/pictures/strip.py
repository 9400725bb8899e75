"""The paper's figure 3: frames of one run."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise import paper
from equipoise.control.states import Phase
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.report.pictures.camera import Size
from equipoise.report.pictures.moments import moments, span
from equipoise.report.pictures.rendering import ARROW_PER_U, draw
from equipoise.report.pictures.scene import stage
from equipoise.report.style import drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME: Final[Size] = (440, 440)
"""Of each frame."""
COLUMNS: Final = 3
"""Frames side by side."""
STEP: Final = 0.02
"""Between the moments from which the frames are chosen [s]."""
APART: Final = 0.15
"""Least time between two frames [s]; nearer ones look alike."""


@drawn
def strip(run: RunLog, arm: Arm) -> "Figure":
    """Draw the moments at which a run differs most from standing still, in the order of time.

    They are the release, the largest displacement and lean to either side, and the end. Each is
    named, with its time, displacement, angle and command.

    Args:
        run: The run.
        arm: The arm that ran.

    Raises:
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig did not get as far as balancing.
        OutsideError: There is nothing to draw with.
    """
    chosen = key_moments(run, arm)
    shown, scene = moments(run, arm, list(chosen)), stage(arm, FRAME)
    rows = -(-len(chosen) // COLUMNS)
    figure = new_figure(0.75 + 2.8 * rows, "Frames of a run (the paper's figure 3)")
    panels: Any = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for panel, picture, (time, x, phi, u), what in zip(
        panels,
        draw(scene, shown.q, shown.phi, shown.u),
        shown.captions(),
        chosen.values(),
        strict=False,
    ):
        panel.imshow(picture)
        panel.set_title(f"{what}, {time}", loc="left", fontweight="bold")
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
    """Return times since the release [s] at which a run differs most from standing still.

    Returns:
        The times, in their order, each with what makes it special.
    """
    end = span(run)[1]
    seen = moments(run, arm, np.arange(0.0, end, STEP))
    balancing = len(seen.time)
    if seen.phase:  # a rig comes to rest afterwards
        balancing = next(
            (i for i, phase in enumerate(seen.phase) if phase != Phase.BALANCING.value), balancing
        )
    end = min(end, float(seen.time[balancing - 1]) + STEP)
    x, phi = seen.x[:balancing], seen.phi[:balancing]
    special = {
        "furthest left": np.argmin(x),
        "furthest right": np.argmax(x),
        "leans left most": np.argmin(phi),
        "leans right most": np.argmax(phi),
    }
    found = {0.0: "release", end: "end"}
    for what, row in special.items():
        time = float(seen.time[row])
        if all(abs(time - other) >= APART for other in found):
            found[time] = what
    return dict(sorted(found.items()))
