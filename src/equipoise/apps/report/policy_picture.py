"""Picture of a policy: the boxes of its table with the commanded acceleration of each."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise import paper
from equipoise.apps.style import INK, new_figure, styled, typeset
from equipoise.control.policy import TabularPolicy
from equipoise.logs.run_log import RunLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HATCHED: Final[dict[str, Any]] = {"fill": False, "hatch": "/////", "linewidth": 0.0}
"""Style of unvisited boxes, without a frame: frames mark the boxes of the run."""
LUMA: Final = np.array([0.299, 0.587, 0.114])
"""Luma coefficients of red, green and blue (ITU-R BT.601)."""


@styled()
def policy_picture(policy: TabularPolicy, run: RunLog | None = None) -> "Figure":
    """Draw the commanded acceleration per box: a panel per x and x_dot, with phi and phi_dot axes.

    Args:
        policy: The policy.
        run: A run; the boxes that it visited are framed.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize
    from matplotlib.patches import Patch, Rectangle

    boxes = policy.settings.boxes
    shape = boxes.shape
    u = policy.u_of_box.reshape(shape)
    unvisited = ~np.any(np.array(policy.visits) > 0, axis=1).reshape(shape)
    visited = np.zeros(u.size, bool)
    if run is not None:
        visited[run.box] = True
    framed = visited.reshape(shape)
    largest = 1.2 * float(np.max(np.abs(policy.actions)))
    colours = colormaps["RdBu_r"](Normalize(-largest, largest)(u))
    title = f"Policy: acceleration u [m/s²] in each of the {boxes.count} boxes"
    figure = new_figure(7.0 * max(1.0, shape[1] * shape[3] / 15.0), title)
    axes: Any = figure.subplots(shape[3], shape[2], sharex=True, sharey=True, squeeze=False)
    size = 6.8 * min(1.0, 18.0 / (shape[0] * shape[2]))
    for box in np.ndindex(*shape):
        i, j, k, m = box
        panel = axes[shape[3] - 1 - m, k]  # rows from the top: x_dot high to low
        pen = INK if colours[box][:3] @ LUMA > 0.5 else "white"
        patches = [Rectangle((i, j), 1, 1, facecolor=colours[box], edgecolor="white")]
        if unvisited[box]:
            patches.append(Rectangle((i, j), 1, 1, edgecolor=pen, **HATCHED))
        if framed[box]:  # black on white is visible on dark and light boxes
            frame: Any = {"fill": False, "zorder": 3}
            corner = (i + 0.07, j + 0.07)
            patches.append(Rectangle(corner, 0.86, 0.86, edgecolor="white", lw=2.8, **frame))
            patches.append(Rectangle(corner, 0.86, 0.86, edgecolor=INK, lw=1.3, **frame))
        for patch in patches:
            patch.set_in_layout(False)  # hundreds of patches slow the layout down
            panel.add_patch(patch)
        command: Any = {"ha": "center", "va": "center", "color": pen, "fontsize": size}
        text = panel.text(i + 0.5, j + 0.5, typeset(f"{u[box]:+g}"), in_layout=False, **command)
        if unvisited[box]:
            text.set_bbox({"facecolor": colours[box], "edgecolor": "none", "pad": 1.0})
    for panel in axes.flat:
        panel.grid(visible=False)
        panel.tick_params(length=0)
        panel.spines[:].set_visible(False)
        panel.set(xlim=(0, shape[0]), ylim=(0, shape[1]))
    _label(axes, 0, boxes.phi_deg, paper.PHI_LIMIT_DEG, "φ [°]")
    _label(axes, 1, boxes.phi_dot_deg, inf, "dφ/dt [°/s]")
    for panel, (low, high) in zip(axes[0], pairwise(_edges(boxes.x, paper.X_LIMIT)), strict=True):
        panel.set_title(f"x from {low} to {high} m", ha="center", x=0.5)
    beside: Any = {"rotation": -90, "va": "center", "xycoords": "axes fraction"}
    speeds = pairwise(_edges(boxes.x_dot, inf))
    for panel, (low, high) in zip(axes[::-1, -1], speeds, strict=True):
        panel.annotate(f"dx/dt from {low} to {high} m/s", (1.03, 0.5), **beside)
    notes = [Patch(label="never visited in training", edgecolor=INK, **HATCHED)]
    if run is not None:
        label = f"{int(visited.sum())} boxes visited by the recorded run"
        notes.append(Patch(fill=False, edgecolor=INK, linewidth=1.6, label=label))
    figure.legend(handles=notes, loc="outside lower center", ncols=2)
    return figure


def _edges(ends: Sequence[float], limit: float) -> list[str]:
    """Return the edges of all intervals as text."""
    return [typeset(f"{end:g}".replace("inf", "∞")) for end in (-limit, *ends, limit)]


def _label(axes: Any, side: int, ends: Sequence[float], limit: float, name: str) -> None:
    """Label the edges of the boxes on the lower (0) or left (1) side."""
    edges = _edges(ends, limit)
    for panel in axes[-1] if side == 0 else axes[:, 0]:
        axis = panel.yaxis if side else panel.xaxis
        axis.set_ticks(range(len(edges)), edges)
        axis.set_label_text(name)
