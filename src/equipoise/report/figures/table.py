"""The policy as a picture: 270 boxes, and the acceleration that it commands in each."""

from typing import TYPE_CHECKING, Any

import numpy as np

from equipoise import paper
from equipoise.control.boxes import SHAPE
from equipoise.control.policy import TabularPolicy
from equipoise.report.style import INK, drawn, new_figure
from equipoise.runlog import RunLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP = "cividis"
"""Lightness rises with u, so that the sign is seen in grey as well."""
LUMA = np.array([0.299, 0.587, 0.114])
"""How light red, green and blue look."""


@drawn
def policy_picture(policy: TabularPolicy, run: RunLog | None = None) -> "Figure":
    """Draw what the policy does where: a panel for each x and x_dot, phi against phi_dot in it.

    Args:
        policy: The policy.
        run: A run whose boxes are framed.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm
    from matplotlib.patches import Patch, Rectangle

    u = policy.u_of_box.reshape(SHAPE)
    unvisited = ~np.any(np.array(policy.visits) > 0, axis=1).reshape(SHAPE)
    seen = np.zeros(SHAPE, np.bool_)
    if run is not None:
        seen = np.bincount(run.box, minlength=u.size).reshape(SHAPE) > 0
    actions = np.array(policy.actions)
    middle = 0.5 * (actions[1:] + actions[:-1])
    edges = np.concatenate(([2 * actions[0] - middle[0]], middle, [2 * actions[-1] - middle[-1]]))
    norm, colours = BoundaryNorm(edges, 256), colormaps[MAP]

    figure = new_figure(7.0, "What the policy does where: u in each of the 270 boxes")
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
                _add(panel, Rectangle((i, j), 1, 1, fill=False, hatch="/////", edgecolor=pen))
            text = panel.text(
                i + 0.5, j + 0.5, _signed(float(u[i, j, k, m])), color=pen, fontsize=6.8
            )
            text.set(ha="center", va="center", in_layout=False)
            if unvisited[i, j, k, m]:
                text.set_bbox({"facecolor": fill, "edgecolor": "none", "pad": 1.0})
            if seen[i, j, k, m]:
                # Black on white: seen on dark boxes and on light ones, in colour and in grey.
                for colour, width in (("white", 2.8), (INK, 1.3)):
                    frame = Rectangle((i + 0.07, j + 0.07), 0.86, 0.86, fill=False, zorder=3)
                    frame.set(edgecolor=colour, linewidth=width)
                    _add(panel, frame)
    for k, interval in enumerate(paper.X_INTERVALS):
        where = ("left", "middle", "right")[k]
        axes[0, k].set_title(f"{where}: x in {_interval(interval)} m", ha="center", x=0.5)
    for m, interval in enumerate(paper.X_DOT_INTERVALS):
        how = ("moving left", "slow", "moving right")[m]
        axes[SHAPE[3] - 1 - m, -1].annotate(
            f"{how}:\ndx/dt in {_interval(interval)} m/s",
            (1.03, 0.5),
            xycoords="axes fraction",
            rotation=-90,
            va="center",
            ma="center",
        )
    _edges(axes)
    bar = figure.colorbar(
        ScalarMappable(norm, colours), ax=axes, location="right", shrink=0.6, aspect=30, pad=0.02
    )
    bar.set_ticks(actions.tolist(), labels=[_signed(action) for action in actions])
    bar.minorticks_off()
    bar.set_label("u [m/s²]: the flange accelerates towards \N{MINUS SIGN}x (dark) or +x (light)")
    notes = [Patch(fill=False, edgecolor=INK, hatch="/////", label="never visited in training")]
    if run is not None:
        label = f"{int(seen.sum())} boxes that the deployment run saw"
        notes.append(Patch(fill=False, edgecolor=INK, linewidth=1.6, label=label))
    figure.legend(handles=notes, loc="outside lower center", ncols=2)
    return figure


def _edges(axes: Any) -> None:
    phi = [paper.PHI_INTERVALS_DEG[0].low, *(i.high for i in paper.PHI_INTERVALS_DEG)]
    phi_dot = [paper.PHI_DOT_INTERVALS_DEG[0].low, *(i.high for i in paper.PHI_DOT_INTERVALS_DEG)]
    for panel in axes[-1]:
        panel.set_xticks(range(len(phi)), [_number(edge) for edge in phi])
        panel.set_xlabel("φ [deg]")
    for panel in axes[:, 0]:
        panel.set_yticks(range(len(phi_dot)), [_number(edge) for edge in phi_dot])
        panel.set_ylabel("dφ/dt [deg/s]")
    for panel in axes.flat:
        panel.tick_params(length=0)
        for spine in panel.spines.values():
            spine.set_visible(False)


def _add(panel: Any, patch: Any) -> None:
    # Hundreds of patches and texts inside the panels need no place in the layout.
    patch.set_in_layout(False)
    panel.add_patch(patch)


def _interval(interval: paper.Interval) -> str:
    return _minus(str(interval).replace("+", "").replace("inf", "∞"))


def _signed(value: float) -> str:
    return _minus(f"{value:+g}")


def _number(value: float) -> str:
    return _minus(f"{value:g}".replace("inf", "∞"))


def _minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")
