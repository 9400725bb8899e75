"""Picture of a policy: the boxes of its table with the commanded acceleration of each."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import inf, isinf
from typing import TYPE_CHECKING, Any

import numpy as np

from equipoise import paper
from equipoise.apps.report.style import INK, new_figure, styled, typeset
from equipoise.control.policy import TabularPolicy
from equipoise.logs.run_log import RunLog
from equipoise.settings import BoxSettings

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

    ends = policy.settings.boxes
    shape = ends.shape
    u = policy.u_of_box.reshape(shape)
    unvisited = ~np.any(np.array(policy.visits) > 0, axis=1).reshape(shape)
    boxes = np.array([], np.intp) if run is None else run.box
    visited_by_run = np.bincount(boxes, minlength=u.size).reshape(shape) > 0
    actions = np.array(policy.actions)
    largest = float(np.max(np.abs(actions)))
    norm, colours = Normalize(-1.2 * largest, 1.2 * largest), colormaps[MAP]

    drifted = f", with x after {ends.look_ahead:g} s of drift" if ends.look_ahead > 0.0 else ""
    title = f"Policy: acceleration u in each of the {ends.count} boxes{drifted}"
    figure = new_figure(7.0 * max(1.0, shape[1] * shape[3] / 15.0), title)
    axes: Any = figure.subplots(shape[3], shape[2], sharex=True, sharey=True, squeeze=False)
    size = 6.8 * min(1.0, 18.0 / (shape[0] * shape[2]))
    for k, m in np.ndindex(*shape[2:]):
        # Rows from the top: x_dot high to low; columns: x low to high.
        panel = axes[shape[3] - 1 - m, k]
        panel.grid(visible=False)
        colours_of = colours(norm(u[:, :, k, m].T))
        panel.pcolormesh(colours_of, edgecolor="white", linewidth=0.8)
        for i, j in np.ndindex(*shape[:2]):
            fill = colours_of[j, i]
            pen = INK if fill[:3] @ LUMA > 0.5 else "white"
            if unvisited[i, j, k, m]:
                _add(panel, Rectangle((i, j), 1, 1, edgecolor=pen, **HATCHED))
            command = typeset(f"{u[i, j, k, m]:+g}")
            text = panel.text(i + 0.5, j + 0.5, command, color=pen, fontsize=size)
            text.set(ha="center", va="center", in_layout=False)
            if unvisited[i, j, k, m]:
                text.set_bbox({"facecolor": fill, "edgecolor": "none", "pad": 1.0})
            if visited_by_run[i, j, k, m]:
                # Black on white is visible on dark and light boxes, in colour and in grey.
                for colour, width in (("white", 2.8), (INK, 1.3)):
                    frame = Rectangle((i + 0.07, j + 0.07), 0.86, 0.86, fill=False, zorder=3)
                    frame.set(edgecolor=colour, linewidth=width)
                    _add(panel, frame)
    for k, (side, between) in enumerate(_intervals("x", ends.x, paper.X_LIMIT)):
        where = ("left", "middle", "right")[side]
        axes[0, k].set_title(f"{where}: {between} m", ha="center", x=0.5)
    for m, (side, between) in enumerate(_intervals("dx/dt", ends.x_dot, inf)):
        how = ("moving left", "slow", "moving right")[side]
        look: Any = {"rotation": -90, "va": "center", "ma": "center"}
        beside = f"{how}:\n{between} m/s"
        axes[shape[3] - 1 - m, -1].annotate(beside, (1.03, 0.5), xycoords="axes fraction", **look)
    _label_edges(axes, ends)
    where: Any = {"location": "right", "shrink": 0.6, "aspect": 30, "pad": 0.02}
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, **where)
    bar.set_ticks(actions.tolist(), labels=[typeset(f"{action:+g}") for action in actions])
    bar.minorticks_off()
    bar.set_label("u [m/s²]: the flange accelerates towards \N{MINUS SIGN}x (blue) or +x (red)")
    notes = [Patch(label="never visited in training", edgecolor=INK, **HATCHED)]
    if run is not None:
        label = f"{int(visited_by_run.sum())} boxes visited by the recorded run"
        notes.append(Patch(fill=False, edgecolor=INK, linewidth=1.6, label=label))
    figure.legend(handles=notes, loc="outside lower center", ncols=2)
    return figure


def _label_edges(axes: Any, ends: BoxSettings) -> None:
    phi, phi_dot = (
        [_number(end) for end in (-limit, *inner, limit)]
        for inner, limit in ((ends.phi_deg, paper.PHI_LIMIT_DEG), (ends.phi_dot_deg, inf))
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


def _intervals(name: str, ends: Sequence[float], limit: float) -> Iterator[tuple[int, str]]:
    """Yield the side of each interval (0 negative, 1 around zero, 2 positive) and its inequality.

    Inequalities need no legend for brackets. An end belongs to the interval farther from zero.
    """
    for low, high in pairwise((-limit, *ends, limit)):
        left = "≤" if low >= 0.0 and low > -limit else "<"
        right = "≤" if high < 0.0 else "<"
        side = 0 if high <= 0.0 else 2 if low >= 0.0 else 1
        if isinf(low):
            yield side, f"{name} {right} {_number(high)}"
        elif isinf(high):
            yield side, f"{name} {left.replace('≤', '≥').replace('<', '>')} {_number(low)}"
        else:
            yield side, f"{_number(low)} {left} {name} {right} {_number(high)}"


def _number(value: float) -> str:
    return typeset(f"{value:g}".replace("inf", "∞"))
