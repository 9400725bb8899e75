"""Recoverable set in slices of the state space, and the starts that a policy holds."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.report import style
from equipoise.studies.recovery_map import MapSlice, RecoveryMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLES: Final = {
    "pendulum": "flange at rest in the middle",
    "flange": "pendulum upright at rest",
}
LABELS: Final = {"pendulum": ("φ [°]", "dφ/dt [°/s]"), "flange": ("x [m]", "dx/dt [m/s]")}
HELD: Final[dict[str, Any]] = {"color": style.BLUE, "marker": "s", "linewidths": 0.0}
LOST: Final[dict[str, Any]] = {"color": style.VERMILION, "marker": "x", "linewidths": 0.7}
OUTSIDE: Final[dict[str, Any]] = {"color": style.GREY, "marker": ".", "linewidths": 0.0}
AREA: Final = 12000.0
"""Area of all marks of a panel [pt^2], so that neighbours do not touch."""


@style.styled()
def recovery_figure(found: RecoveryMap) -> "Figure":
    """Draw a map of the recoverable set."""
    title = f"Recoverable starts, and those that the policy holds, world {found.world}"
    figure = style.new_figure(4.3, title)
    count = len(found.slices)
    axes: Any = figure.subplots(1, count, squeeze=False)[0]
    for panel, one in zip(axes, found.slices, strict=True):
        _slice(panel, one)
        if one.plane == "pendulum":
            _releases(panel, found)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _slice(panel: Any, one: MapSlice) -> None:
    unit = 180.0 / np.pi if one.plane == "pendulum" else 1.0
    starts, held = unit * np.array(one.starts), np.array(one.held)
    inside = np.array(one.depth) <= 1.0
    size = AREA / len(starts)
    for which, look, factor, label in (
        (~inside & ~held, OUTSIDE, 0.5, "lost, no controller recovers it"),
        (inside & ~held, LOST, 1.0, "lost, recoverable"),
        (held, HELD, 1.0, "held by the policy"),
    ):
        panel.scatter(*starts[which].T, s=factor * size, label=label, zorder=2, **look)
    for points, line, label in (
        (one.necessary, {"linestyle": "-", "linewidth": 1.8}, "beyond: no controller recovers"),
        (one.sufficient, {"linestyle": style.DASHES}, "within: a known command recovers"),
    ):
        closed = unit * np.array([*points, points[0]])
        panel.plot(*closed.T, color=style.INK, label=label, zorder=3, **line)
    across, up = LABELS[one.plane]
    panel.set_xlabel(across)
    panel.set_ylabel(up)
    share = one.held_share("necessary")
    part, low, high = (f"{100.0 * value:.0f}" for value in (share.share, *share.interval))
    held_part = f"holds {part} % [{low}, {high}] of the recoverable set"
    panel.set_title(f"{TITLES[one.plane]}\n{held_part}")


def _releases(panel: Any, found: RecoveryMap) -> None:
    from matplotlib.patches import Rectangle

    e = found.settings.evaluation
    low, high = np.rad2deg((e.phi_low, e.phi_dot_low)), np.rad2deg((e.phi_high, e.phi_dot_high))
    for sign, label in ((1.0, "releases by hand"), (-1.0, None)):
        width, height = sign * (high - low)
        look: Any = {"fill": False, "edgecolor": style.ORANGE, "linewidth": 2.0, "zorder": 4}
        panel.add_patch(Rectangle(tuple(sign * low), width, height, label=label, **look))
