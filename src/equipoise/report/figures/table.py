"""Picture of a policy: 270 boxes with the commanded acceleration of each."""

from math import isinf
from typing import TYPE_CHECKING, Any

import numpy as np

from equipoise import paper
from equipoise.control.boxes import SHAPE
from equipoise.control.policy import TabularPolicy
from equipoise.logs.run_log import RunLog
from equipoise.report.style import INK, new_figure, styled, typeset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP = "RdBu_r"
"""Diverging colour map: blue below zero, white at zero, red above; numbers serve grey prints."""
HATCHED: dict[str, Any] = {"fill": False, "hatch": "/////", "linewidth": 0.0}
"""Style of unvisited boxes, without a frame: frames mark the boxes of the run."""
LUMA = np.array([0.299, 0.587, 0.114])
"""Luma coefficients of red, green and blue (ITU-R BT.601)."""


@styled()
def policy_picture(policy: TabularPolicy, run: RunLog | None = None) -> "Figure":
    """Draw the commanded acceleration per box: a panel per x and x_dot, with phi and phi_dot axes.

    Args:
        policy: The policy.
        run: A run; the boxes that it visited are framed.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Patch, Rectangle

    u = policy.u_of_box.reshape(SHAPE)
    unvisited = ~np.any(np.array(policy.visits) > 0, axis=1).reshape(SHAPE)
    boxes = np.array([], np.intp) if run is None else run.box
    visited_by_run = np.bincount(boxes, minlength=u.size).reshape(SHAPE) > 0
    actions = np.array(policy.actions)
    largest = float(np.max(np.abs(actions)))
    norm, colours = Normalize(-1.2 * largest, 1.2 * largest), colormaps[MAP]

    look_ahead = policy.settings.controller.look_ahead
    drifted = f", with x after {look_ahead:g} s of drift" if look_ahead > 0.0 else ""
    figure = new_figure(7.0, f"Policy: acceleration u in each of the 270 boxes{drifted}")
    axes: Any = figure.subplots(3, 3, sharex=True, sharey=True)
    for k, m in np.ndindex(*SHAPE[2:]):
        # Rows from the top: x_dot high to low; columns: x low to high.
        panel = axes[SHAPE[3] - 1 - m, k]
        panel.grid(visible=False)
        colours_of = colours(norm(u[:, :, k, m].T))
        panel.pcolormesh(colours_of, edgecolor="white", linewidth=0.8)
        for i, j in np.ndindex(*SHAPE[:2]):
            fill = colours_of[j, i]
            pen = INK if fill[:3] @ LUMA > 0.5 else "white"
            if unvisited[i, j, k, m]:
                _add(panel, Rectangle((i, j), 1, 1, edgecolor=pen, **HATCHED))
            command = typeset(f"{u[i, j, k, m]:+g}")
            text = panel.text(i + 0.5, j + 0.5, command, color=pen, fontsize=6.8)
            text.set(ha="center", va="center", in_layout=False)
            if unvisited[i, j, k, m]:
                text.set_bbox({"facecolor": fill, "edgecolor": "none", "pad": 1.0})
            if visited_by_run[i, j, k, m]:
                # Black on white is visible on dark and light boxes, in colour and in grey.
                for colour, width in (("white", 2.8), (INK, 1.3)):
                    frame = Rectangle((i + 0.07, j + 0.07), 0.86, 0.86, fill=False, zorder=3)
                    frame.set(edgecolor=colour, linewidth=width)
                    _add(panel, frame)
    for k, where in enumerate(("left", "middle", "right")):
        title = f"{where}: {_between('x', paper.X_INTERVALS[k])} m"
        axes[0, k].set_title(title, ha="center", x=0.5)
    for m, how in enumerate(("moving left", "slow", "moving right")):
        title = f"{how}:\n{_between('dx/dt', paper.X_DOT_INTERVALS[m])} m/s"
        look: Any = {"rotation": -90, "va": "center", "ma": "center"}
        axes[SHAPE[3] - 1 - m, -1].annotate(title, (1.03, 0.5), xycoords="axes fraction", **look)
    _edges(axes)
    shape: Any = {"location": "right", "shrink": 0.6, "aspect": 30, "pad": 0.02}
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, **shape)
    bar.set_ticks(actions.tolist(), labels=[typeset(f"{action:+g}") for action in actions])
    bar.minorticks_off()
    bar.set_label("u [m/s²]: the flange accelerates towards \N{MINUS SIGN}x (blue) or +x (red)")
    notes = [Patch(label="never visited in training", edgecolor=INK, **HATCHED)]
    if run is not None:
        label = f"{int(visited_by_run.sum())} boxes visited by the recorded run"
        notes.append(Patch(fill=False, edgecolor=INK, linewidth=1.6, label=label))
    figure.legend(handles=notes, loc="outside lower center", ncols=2)
    return figure


def _edges(axes: Any) -> None:
    phi, phi_dot = (
        [_number(intervals[0].low), *(_number(interval.high) for interval in intervals)]
        for intervals in (paper.PHI_INTERVALS_DEG, paper.PHI_DOT_INTERVALS_DEG)
    )
    for panel in axes[-1]:
        panel.set_xticks(range(len(phi)), phi)
        panel.set_xlabel("φ [°]")
    for panel in axes[:, 0]:
        panel.set_yticks(range(len(phi_dot)), phi_dot)
        panel.set_ylabel("dφ/dt [°/s]")
    for panel in axes.flat:
        panel.tick_params(length=0)
        panel.spines[:].set_visible(False)


def _add(panel: Any, patch: Any) -> None:
    # Excluding hundreds of patches and texts speeds up the layout.
    patch.set_in_layout(False)
    panel.add_patch(patch)


def _between(name: str, interval: paper.Interval) -> str:
    """Format an interval as inequalities, which need no legend for brackets."""
    low, high = (_number(end) for end in (interval.low, interval.high))
    left, right = ("≤" if closed else "<" for closed in (interval.low_closed, interval.high_closed))
    if isinf(interval.low):
        return f"{name} {right} {high}"
    if isinf(interval.high):
        return f"{name} {left.replace('≤', '≥').replace('<', '>')} {low}"
    return f"{low} {left} {name} {right} {high}"


def _number(value: float) -> str:
    return typeset(f"{value:g}".replace("inf", "∞"))
