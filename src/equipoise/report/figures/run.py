"""The paper's figures 4 to 7: one run of the policy.

The paper shows 5 s. A longer run is shown twice: its first seconds, to be read as the paper's
figures, and the whole.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.report.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    PALE,
    PURPLE,
    SKY,
    VERMILION,
    drawn,
    edge_lines,
    limit_lines,
    new_figure,
)
from equipoise.runlog import RunLog
from equipoise.studies.results import LASTED, how_it_ended

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

JOINT_LINES: tuple[dict[str, Any], ...] = (
    {"color": SKY, "linestyle": "-", "linewidth": 2.8},
    {"color": VERMILION, "linestyle": (0, (5, 1.5))},
    {"color": PALE, "linestyle": "-", "linewidth": 2.8},
    {"color": GREEN, "linestyle": (0, (6, 1.5, 1, 1.5))},
    {"color": GREY, "linestyle": (0, (1.5, 1))},
    {"color": PURPLE, "linestyle": (0, (8, 2))},
    {"color": INK, "linestyle": (0, (3, 1.5))},
)
"""Wide and pale where another joint moves alike on top of it: A1 and A7, A3 and A5."""


@drawn
def commands(run: RunLog) -> "Figure":
    """Draw the commanded accelerations as steps, and how often each was commanded when.

    Args:
        run: The run.
    """
    figure = new_figure(4.4, "Commanded acceleration u of the flange (the paper's figure 4)")
    axes: Any = figure.subplots(2, 1, height_ratios=(3, 2))
    first = run.time < paper.SECONDS_BALANCED
    held_until = np.append(run.time[first], run.time[first][-1] + run.conditions.h)
    axes[0].stairs(run.u[first], held_until, baseline=None, color=INK, linewidth=0.8)
    actions = list(paper.ACTIONS)
    axes[0].set_yticks(actions, [f"{action:+g}".replace("-", "−") for action in actions])
    axes[0].set_ylabel("u [m/s²]")
    axes[0].set_xlim(0.0, max(paper.SECONDS_BALANCED, 0.1))
    error = float(np.sqrt(np.mean((run.tracked - run.u) ** 2)))
    axes[0].set_title(
        f"the first {paper.SECONDS_BALANCED:g} s; the arm tracks u to {error:.2g} m/s² RMS"
    )
    _shares_of_actions(figure, axes[1], run, actions)
    axes[1].set_xlabel("time [s]")
    return figure


def _shares_of_actions(figure: Any, panel: Any, run: RunLog, actions: list[float]) -> None:
    seconds = np.arange(np.ceil(run.lasted - 1e-9) + 1.0)
    levels = np.arange(len(actions) + 1) - 0.5
    nearest = np.abs(run.u[:, None] - np.array(actions)).argmin(axis=1)
    counts, _, _ = np.histogram2d(run.time, nearest, bins=(seconds, levels))
    share = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    mesh = panel.pcolormesh(seconds, levels, share.T, cmap="Greys", vmin=0.0)
    panel.grid(visible=False)
    panel.set_yticks(range(len(actions)), [f"{action:+g}".replace("-", "−") for action in actions])
    panel.set_ylabel("u [m/s²]")
    panel.set_title(f"all {run.lasted:g} s: how often each was commanded in each second")
    figure.colorbar(mesh, ax=panel, label="share [%]", pad=0.01)


@drawn
def joints(run: RunLog) -> "Figure":
    """Draw the joint positions, and how far each moves from where it started.

    Args:
        run: The run.
    """
    held, names = run.conditions.held_joint, run.conditions.joints
    degrees = np.rad2deg(run.q)
    figure = new_figure(5.4, "Joint positions (the paper's figure 5)")
    spans = _spans(run)
    axes: Any = figure.subplots(
        2, len(spans), sharex="col", sharey="row", squeeze=False, width_ratios=[3, 2][: len(spans)]
    )
    labels = [f"{name}{' (held)' if n == held else ''}" for n, name in enumerate(names, 1)]
    for column, (until, title) in enumerate(spans):
        shown = run.time < until
        for j, label in enumerate(labels):
            line = JOINT_LINES[j % len(JOINT_LINES)]
            axes[0, column].plot(run.time[shown], degrees[shown, j], label=label, **line)
            moved = degrees[shown, j] - degrees[0, j]
            axes[1, column].plot(run.time[shown], moved, **line)
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel("time [s]")
        axes[1, column].set_xlim(0.0, until)
    axes[0, 0].set_ylabel("joint position [deg]")
    axes[1, 0].set_ylabel("change since the start [deg]")
    handles, names_ = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names_, loc="outside lower center", ncols=len(labels))
    return figure


@drawn
def pendulum(run: RunLog) -> "Figure":
    """Draw angle and angular velocity of the pendulum, with the limits of failure.

    Args:
        run: The run.
    """
    limit = paper.PHI_LIMIT_DEG
    inner = [interval.high for interval in paper.PHI_INTERVALS_DEG[:-1]]
    inner_dot = [interval.high for interval in paper.PHI_DOT_INTERVALS_DEG[:-1]]
    return _two_series(
        run,
        "Angle and angular velocity of the pendulum (the paper's figure 6)",
        ("φ [deg]", np.rad2deg(run.phi), inner, (-limit, limit), f"failure at ±{limit:g}°"),
        ("dφ/dt [deg/s]", np.rad2deg(run.phi_dot), inner_dot, (), ""),
    )


@drawn
def flange(run: RunLog) -> "Figure":
    """Draw displacement and velocity of the flange, with the ends of the track.

    Args:
        run: The run.
    """
    limit = paper.X_LIMIT
    inner = [interval.high for interval in paper.X_INTERVALS[:-1]]
    inner_dot = [interval.high for interval in paper.X_DOT_INTERVALS[:-1]]
    return _two_series(
        run,
        "Displacement and velocity of the flange along x (the paper's figure 7)",
        ("x [m]", run.x, inner, (-limit, limit), f"failure at ±{limit:g} m"),
        ("dx/dt [m/s]", run.x_dot, inner_dot, (), ""),
    )


def _two_series(
    run: RunLog, title: str, *rows: tuple[str, Array, Sequence[float], Sequence[float], str]
) -> "Figure":
    from matplotlib.lines import Line2D

    figure = new_figure(4.6, title)
    spans = _spans(run)
    axes: Any = figure.subplots(len(rows), len(spans), sharex="col", sharey="row", squeeze=False)
    for row, (label, values, edges, limits, limit_label) in enumerate(rows):
        for column, (until, span_title) in enumerate(spans):
            panel, shown = axes[row, column], run.time < until
            panel.grid(visible=False, axis="y")
            edge_lines(panel, edges)
            limit_lines(panel, limits, limit_label if column == 0 else "")
            panel.plot(run.time[shown], values[shown], color=BLUE, linewidth=0.9)
            panel.set_xlim(0.0, until)
            if row == 0:
                panel.set_title(span_title)
            if row == len(rows) - 1:
                panel.set_xlabel("time [s]")
        axes[row, 0].set_ylabel(label)
        largest = max(np.max(np.abs(values)), *(abs(edge) for edge in edges), *map(abs, limits))
        axes[row, 0].set_ylim(-1.2 * largest, 1.2 * largest)
    edge = Line2D([], [], color=GREY, linewidth=0.6, linestyle=(0, (1, 2)))
    figure.legend([edge], ["edges of the boxes"], loc="outside lower center")
    return figure


def _spans(run: RunLog) -> list[tuple[float, str]]:
    """Return the spans to draw, from the start until when, with their titles."""
    short, cause = paper.SECONDS_BALANCED, run.conditions.cause
    end = f"all {run.lasted:g} s" + (f", then it {how_it_ended(cause)}" if cause != LASTED else "")
    if run.lasted <= 1.5 * short:
        return [(max(run.lasted, run.conditions.h), end)]
    return [(short, f"the first {short:g} s, as long as the paper's"), (run.lasted, end)]
