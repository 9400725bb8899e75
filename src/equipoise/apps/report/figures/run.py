"""The paper's figures 4 to 7: one run of the policy.

The paper shows 5 s. A longer run is shown twice: its first seconds, comparable with the paper's
figures, and the whole run.

On a rig the policy's observation is a prediction of the state at which its command takes effect.
Where a simulation provides the true state, the first seconds show both, and the whole run shows the
true state.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.apps.report import style
from equipoise.apps.report.style import new_figure, styled, typeset
from equipoise.logs.run_log import RunLog
from equipoise.reproduction.results import observation_differs
from equipoise.worlds.formatting import LASTED, format_end

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

JOINT_LINES: tuple[dict[str, Any], ...] = (
    {"color": style.SKY, "linestyle": "-", "linewidth": 2.8},
    {"color": style.VERMILION, "linestyle": (0, (5, 1.5))},
    {"color": style.PALE, "linestyle": "-", "linewidth": 2.8},
    {"color": style.GREEN, "linestyle": style.DASH_DOTS},
    {"color": style.GREY, "linestyle": (0, (1.5, 1))},
    {"color": style.PURPLE, "linestyle": (0, (8, 2))},
    {"color": style.INK, "linestyle": (0, (3, 1.5))},
)
"""Wide pale lines for joints that another joint's line covers: A1 below A7, A3 below A5."""

LEVELS: Final = [typeset(f"{action:+g}") for action in paper.ACTIONS]
"""Tick labels of the accelerations."""
CLOSE_UP: Final = 1.0
"""Length of the close-up that shows the lag of the flange [s]."""

TRUE_LINE: Final[dict[str, Any]] = {"color": style.SKY, "linewidth": 2.4}
"""True state: wide and pale below the thin dark line of the observation, distinct in grey too."""
OBSERVED_LINE: Final[dict[str, Any]] = {"color": style.INK, "linewidth": 0.8}
LIMIT_LINE: Final[dict[str, Any]] = {"color": style.INK, "linewidth": 1.0, "linestyle": (0, (6, 2))}
EDGE_LINE: Final[dict[str, Any]] = {"color": style.GREY, "linewidth": 0.6, "linestyle": (0, (1, 2))}
ONLY_LINE: Final[dict[str, Any]] = {"color": style.BLUE, "linewidth": 0.9}


@styled()
def commands(run: RunLog) -> "Figure":
    """Draw the commanded accelerations as steps, and the share of each per second.

    On a rig a close-up shows the lagged response of the flange.
    """
    real = observation_differs(run)
    heights = (3, 3, 2) if real else (3, 2)
    figure = new_figure(6.4 if real else 4.4, "Commanded acceleration u (the paper's figure 4)")
    axes: Any = figure.subplots(len(heights), 1, height_ratios=heights)
    title = f"the first {paper.SECONDS_BALANCED:g} s"
    if not real:
        error = float(np.sqrt(np.mean((run.tracked - run.u) ** 2)))
        title += f"; the arm tracks u to {error:.2g} m/s² RMS"
    _steps(axes[0], run, paper.SECONDS_BALANCED)
    axes[0].set_yticks(paper.ACTIONS, LEVELS)
    axes[0].set_title(title)
    if real:
        # The mean acceleration over a tick is plotted at the middle of the tick.
        middle = run.time + 0.5 * run.conditions.h
        shown = run.time < CLOSE_UP
        axes[1].plot(middle[shown], run.tracked[shown], label="response of the flange", **TRUE_LINE)
        _steps(axes[1], run, CLOSE_UP)
        axes[1].set_ylabel("acceleration [m/s²]")
        axes[1].set_title(f"the first {CLOSE_UP:g} s: lagged response of the flange")
        figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    _shares_of_actions(figure, axes[-1], run)
    axes[-1].set_xlabel("time [s]")
    return figure


def _steps(panel: Any, run: RunLog, until: float) -> None:
    shown = run.time < until
    edges = np.append(run.time[shown], run.time[shown][-1] + run.conditions.h)
    panel.stairs(run.u[shown], edges, baseline=None, label="commanded", **OBSERVED_LINE)
    panel.set_ylabel("u [m/s²]")
    panel.set_xlim(0.0, until)


def _shares_of_actions(figure: Any, panel: Any, run: RunLog) -> None:
    actions = paper.ACTIONS
    seconds = np.arange(np.ceil(run.lasted - 1e-9) + 1.0)
    levels = np.arange(len(actions) + 1) - 0.5
    nearest = np.abs(run.u[:, None] - np.array(actions)).argmin(axis=1)
    counts, _, _ = np.histogram2d(run.time, nearest, bins=(seconds, levels))
    share = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    mesh = panel.pcolormesh(seconds, levels, share.T, cmap="Greys", vmin=0.0)
    panel.grid(visible=False)
    panel.set_yticks(range(len(actions)), LEVELS)
    panel.set_ylabel("u [m/s²]")
    panel.set_title(f"all {run.lasted:g} s: share of each acceleration per second")
    figure.colorbar(mesh, ax=panel, label="share [%]", pad=0.01)


@styled()
def joints(run: RunLog) -> "Figure":
    """Draw commanded joint positions, their changes, and on a rig the tracking error of the arm."""
    real, spans = observation_differs(run), _spans(run)
    rows: list[tuple[str, Array]] = [("joint position [°]", np.rad2deg(run.q))]
    rows.append(("change since the start [°]", rows[0][1] - rows[0][1][0]))
    places: Any = [[f"{row}{column}" for column in range(len(spans))] for row in range(2)]
    if real:
        places.append(["lag"] * len(spans))
    figure = new_figure(7.4 if real else 5.4, "Joint positions (the paper's figure 5)")
    axes: Any = figure.subplot_mosaic(places, width_ratios=[3, 2][: len(spans)])
    for column, (until, title) in enumerate(spans):
        for row, (label, values) in enumerate(rows):
            panel, left = axes[f"{row}{column}"], axes[f"{row}0"]
            _joint_lines(panel, run, values, until)
            if column:
                panel.sharey(left)
                panel.tick_params(labelleft=False)
            left.set_ylabel(label)
        axes[f"0{column}"].set_title(title)
        axes[f"0{column}"].tick_params(labelbottom=False)
        axes[f"1{column}"].set_xlabel("time [s]")
    if real:
        # A command is that of the end of its tick, the true state that of the beginning.
        error = np.zeros_like(run.q)
        error[1:] = np.rad2deg(run.q[:-1] - run.truth.q[1:])
        _joint_lines(axes["lag"], run, error, spans[0][0])
        axes["lag"].set_title("tracking error of the arm")
        axes["lag"].set_ylabel("commanded − real [°]")
        axes["lag"].set_xlabel("time [s]")
    figure.align_ylabels([axes["00"], axes["10"], *([axes["lag"]] if real else [])])
    handles, names = axes["00"].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    return figure


def _joint_lines(panel: Any, run: RunLog, values: Array, until: float) -> None:
    held, shown = run.conditions.arm.held_joint, run.time < until
    for j, name in enumerate(run.conditions.joints):
        label = f"{name}{' (held)' if j + 1 == held else ''}"
        line = JOINT_LINES[j % len(JOINT_LINES)]
        panel.plot(run.time[shown], values[shown, j], label=label, **line)
    panel.set_xlim(0.0, until)


@styled()
def pendulum(run: RunLog) -> "Figure":
    """Draw angle and angular velocity of the pendulum, with the edges of the boxes."""
    title = "Angle and angular velocity of the pendulum (the paper's figure 6)"
    true, deg, boxes = run.truth, np.rad2deg, run.conditions.settings.boxes
    top = ("φ [°]", deg(run.phi), deg(true.phi), boxes.phi_deg)
    bottom = ("dφ/dt [°/s]", deg(run.phi_dot), deg(true.phi_dot), boxes.phi_dot_deg)
    return _series(run, title, top, bottom, paper.PHI_LIMIT_DEG, "°")


@styled()
def flange(run: RunLog) -> "Figure":
    """Draw displacement and velocity of the flange, with the ends of the track."""
    title = "Displacement and velocity of the flange along x (the paper's figure 7)"
    boxes = run.conditions.settings.boxes
    top = ("x [m]", run.x, run.truth.x, boxes.x)
    bottom = ("dx/dt [m/s]", run.x_dot, run.truth.x_dot, boxes.x_dot)
    return _series(run, title, top, bottom, paper.X_LIMIT, " m")


@styled()
def encoder_zero(run: RunLog) -> "Figure":
    """Draw the error of the encoder's zero beside its estimate, for a run with an encoder."""
    figure = new_figure(2.5, "Error of the encoder's zero, and the controller's estimate")
    spans = _spans(run)
    axes: Any = figure.subplots(1, len(spans), sharey=True, squeeze=False)[0]
    error, estimated = run.conditions.zero_error, np.rad2deg(run.bias)
    dashed: Any = {"linewidth": 1.3, "linestyle": (0, (6, 2)), "zorder": 2.5}
    thin: Any = {"color": style.SKY, "linewidth": 0.8}
    for panel, (until, title) in zip(axes, spans, strict=True):
        shown = run.time < until
        if error is not None:
            panel.axhline(np.rad2deg(error), label="true error", color=style.INK, **dashed)
        panel.plot(run.time[shown], estimated[shown], label="estimate while balancing", **thin)
        panel.set_xlim(0.0, until)
        panel.set_title(title)
        panel.set_xlabel("time [s]")
    axes[0].set_ylabel("error of φ [°]")
    largest = max(float(np.max(np.abs(estimated))), abs(np.rad2deg(error or 0.0)), 0.05)
    axes[0].set_ylim(-1.2 * largest, 1.2 * largest)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


Series = tuple[str, Array, Array, Sequence[float]]
"""A quantity: label with unit, observation and true values, shape (n,), and inner ends."""


def _series(
    run: RunLog, title: str, top: Series, bottom: Series, limit: float, unit: str
) -> "Figure":
    """Draw two quantities against time; `limit` is the failure limit of the top one, in `unit`."""
    from matplotlib.lines import Line2D

    figure, real, spans = new_figure(4.8, title), observation_differs(run), _spans(run)
    axes: Any = figure.subplots(2, len(spans), sharex="col", sharey="row", squeeze=False)
    failure = f"failure at ±{limit:g}{unit}"
    axes[0, 0].annotate(failure, (0.0, limit), (3, 2), fontsize=7.5, **style.BESIDE)
    for row, (label, observed, true, edges) in enumerate((top, bottom)):
        limits = [-limit, limit] if row == 0 else []
        for column, (until, _) in enumerate(spans):
            panel, shown = axes[row, column], run.time < until
            panel.grid(visible=False, axis="y")
            for edge in edges:
                panel.axhline(edge, **EDGE_LINE)
            for end in limits:
                panel.axhline(end, **LIMIT_LINE)
            if not real:
                panel.plot(run.time[shown], observed[shown], **ONLY_LINE)
            elif column == 0:
                panel.plot(run.time[shown], true[shown], label="true state", **TRUE_LINE)
                panel.plot(run.time[shown], observed[shown], label="observation", **OBSERVED_LINE)
            else:
                panel.plot(run.time[shown], true[shown], **TRUE_LINE | {"linewidth": 1.0})
            panel.set_xlim(0.0, until)
        axes[row, 0].set_ylabel(label)
        curves = np.concatenate((observed, true if real else [], edges, limits))
        largest = float(np.max(np.abs(curves)))
        axes[row, 0].set_ylim(-1.2 * largest, 1.2 * largest)
    for column, (_, span_title) in enumerate(spans):
        axes[0, column].set_title(span_title)
        axes[1, column].set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    lines, _ = axes[0, 0].get_legend_handles_labels()
    lines.append(Line2D([], [], label="edges of the boxes", **EDGE_LINE))
    figure.legend(handles=lines, loc="outside lower center", ncols=3)
    return figure


def _spans(run: RunLog) -> list[tuple[float, str]]:
    """Return the end of each time span to draw [s], with its title; all start at zero."""
    short, cause = paper.SECONDS_BALANCED, run.cause
    end = f"all {run.lasted:g} s" + (f", then it {format_end(cause)}" if cause != LASTED else "")
    if run.lasted <= 1.5 * short:
        return [(max(run.lasted, run.conditions.h), end)]
    return [(short, f"the first {short:g} s, as long as the paper's"), (run.lasted, end)]
