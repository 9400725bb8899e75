"""Picture of a policy: the boxes of its table with the commanded acceleration of each."""

from itertools import pairwise
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np

from equipoise import paper
from equipoise.apps.style import INK, edges, new_figure, styled, typeset
from equipoise.control.policy import TabularPolicy
from equipoise.logs.run_log import RunLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled()
def policy_picture(policy: TabularPolicy, run: RunLog | None = None) -> "Figure":
    """Draw the commanded acceleration per box: a panel per x and x_dot, with phi and phi_dot axes.

    Boxes without a number were never visited in the training.

    Args:
        policy: The policy.
        run: A run; the boxes that it visited are framed.
    """
    from matplotlib.patches import Rectangle

    boxes = policy.settings.boxes
    shape = boxes.shape
    u = policy.u_of_box.reshape(shape)
    trained = np.any(np.array(policy.visits) > 0, axis=1).reshape(shape)
    framed = np.zeros(u.size, bool)
    if run is not None:
        framed[run.box] = True
    framed = framed.reshape(shape)
    largest = 1.2 * float(np.max(np.abs(policy.actions)))
    title = f"Policy: acceleration u [m/s²] in each of the {boxes.count} boxes"
    figure = new_figure(7.0 * max(1.0, shape[1] * shape[3] / 15.0), title)
    axes: Any = figure.subplots(shape[3], shape[2], sharex=True, sharey=True, squeeze=False)
    size = 6.8 * min(1.0, 18.0 / (shape[0] * shape[2]))
    for k, m in np.ndindex(*shape[2:]):
        panel = axes[shape[3] - 1 - m, k]  # rows from the top: x_dot high to low
        colours: Any = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
        panel.pcolormesh(u[:, :, k, m].T, edgecolors="white", **colours)
        for i, j in np.ndindex(*shape[:2]):
            if trained[i, j, k, m]:
                pen = INK if abs(u[i, j, k, m]) < 0.6 * largest else "white"
                command: Any = {"ha": "center", "va": "center", "color": pen, "fontsize": size}
                text = typeset(f"{u[i, j, k, m]:+g}")
                panel.text(i + 0.5, j + 0.5, text, in_layout=False, **command)
            if framed[i, j, k, m]:
                frame: Any = {"fill": False, "edgecolor": INK, "lw": 1.6, "zorder": 3}
                panel.add_patch(Rectangle((i + 0.07, j + 0.07), 0.86, 0.86, **frame))
        panel.grid(visible=False)
        panel.tick_params(length=0)
        panel.spines[:].set_visible(False)
    phi, rate = edges(boxes.phi_deg, paper.PHI_LIMIT_DEG), edges(boxes.phi_dot_deg, inf)
    for panel in axes[-1]:
        panel.set_xticks(range(len(phi)), phi)
        panel.set_xlabel("φ [°]")
    for panel in axes[:, 0]:
        panel.set_yticks(range(len(rate)), rate)
        panel.set_ylabel("dφ/dt [°/s]")
    for panel, (low, high) in zip(axes[0], pairwise(edges(boxes.x, paper.X_LIMIT)), strict=True):
        panel.set_title(f"x from {low} to {high} m", ha="center", x=0.5)
    beside: Any = {"rotation": -90, "va": "center", "xycoords": "axes fraction"}
    speeds = pairwise(edges(boxes.x_dot, inf))
    for panel, (low, high) in zip(axes[::-1, -1], speeds, strict=True):
        panel.annotate(f"dx/dt from {low} to {high} m/s", (1.03, 0.5), **beside)
    return figure
