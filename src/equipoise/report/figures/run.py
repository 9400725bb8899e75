"""The paper's figures 4 to 7: one run of the policy.

The paper shows 5 s. A longer run is shown twice: its first seconds, to be read as the paper's
figures, and the whole.

On a rig the policy does not see what is, but an estimate of what will be when its command takes
effect. Where a simulation tells what was, the first seconds show both, and the whole shows what
was.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.logs.run_log import RunLog
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
from equipoise.studies.formatting import LASTED, how_it_ended
from equipoise.studies.results import seen_otherwise

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

LEVELS: Final = [f"{action:+g}".replace("-", "\N{MINUS SIGN}") for action in paper.ACTIONS]
"""The accelerations, as they are written beside an axis."""
CLOSE_UP: Final = 1.0
"""Time in which a follower's lag can be seen [s]."""

WAS: Final[dict[str, Any]] = {"color": SKY, "linewidth": 2.4}
"""What was, below the thin dark line of what the policy saw: told apart in grey as well."""
SEEN: Final[dict[str, Any]] = {"color": INK, "linewidth": 0.8}
ALONE: Final[dict[str, Any]] = {"color": BLUE, "linewidth": 0.9}


class _Row(NamedTuple):
    """A quantity against time."""

    label: str
    """Its name, with the unit."""
    seen: Array
    """As the policy saw it, shape (n,)."""
    was: Array | None
    """As it was, where that differs, shape (n,)."""
    edges: Sequence[float] = ()
    """Inner edges of the boxes."""
    limits: Sequence[float] = ()
    """Where the attempt has failed."""
    limit_label: str = ""
    """What is written there."""


@drawn
def commands(run: RunLog) -> "Figure":
    """Draw the commanded accelerations as steps, and how often each was commanded when.

    On a rig a close-up shows how late and how smoothly the flange follows.

    Args:
        run: The run.
    """
    real = seen_otherwise(run)
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
        # The mean acceleration over a tick belongs in its middle.
        middle = run.time + 0.5 * run.conditions.h
        shown = run.time < CLOSE_UP
        axes[1].plot(middle[shown], run.tracked[shown], label="what the flange did", **WAS)
        _steps(axes[1], run, CLOSE_UP)
        axes[1].set_ylabel("acceleration [m/s²]")
        axes[1].set_title(f"the first {CLOSE_UP:g} s: the flange follows, later and in its own way")
        figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    _shares_of_actions(figure, axes[-1], run)
    axes[-1].set_xlabel("time [s]")
    return figure


def _steps(panel: Any, run: RunLog, until: float) -> None:
    shown = run.time < until
    held_until = np.append(run.time[shown], run.time[shown][-1] + run.conditions.h)
    panel.stairs(
        run.u[shown], held_until, baseline=None, color=INK, linewidth=0.8, label="commanded"
    )
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
    panel.set_title(f"all {run.lasted:g} s: how often each was commanded in each second")
    figure.colorbar(mesh, ax=panel, label="share [%]", pad=0.01)


@drawn
def joints(run: RunLog) -> "Figure":
    """Draw the commanded joints, how far each moves, and on a rig how far the arm is behind.

    Args:
        run: The run.
    """
    real, spans = seen_otherwise(run), _spans(run)
    places: Any = [[f"{row}{column}" for column in range(len(spans))] for row in ("at", "moved")]
    if real:
        places.append(["behind"] * len(spans))
    figure = new_figure(7.4 if real else 5.4, "Joint positions (the paper's figure 5)")
    axes: Any = figure.subplot_mosaic(places, width_ratios=[3, 2][: len(spans)])
    commanded = np.rad2deg(run.q)
    for column, (until, title) in enumerate(spans):
        at, moved = axes[f"at{column}"], axes[f"moved{column}"]
        if column:
            at.sharey(axes["at0"])
            moved.sharey(axes["moved0"])
            at.tick_params(labelleft=False)
            moved.tick_params(labelleft=False)
        _lines(at, run, commanded, until)
        _lines(moved, run, commanded - commanded[0], until)
        at.set_title(title)
        at.tick_params(labelbottom=False)
        moved.set_xlabel("time [s]")
    axes["at0"].set_ylabel("joint position [°]")
    axes["moved0"].set_ylabel("change since the start [°]")
    if real:
        # A command stands for the end of its tick, the truth for the beginning.
        ahead = np.zeros_like(commanded)
        ahead[1:] = np.rad2deg(run.q[:-1] - run.truth.q[1:])
        _lines(axes["behind"], run, ahead, spans[0][0])
        axes["behind"].set_title("how far the arm is behind its commands")
        axes["behind"].set_ylabel("commanded − real [°]")
        axes["behind"].set_xlabel("time [s]")
    figure.align_ylabels([axes["at0"], axes["moved0"], *([axes["behind"]] if real else [])])
    handles, names = axes["at0"].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    return figure


def _lines(panel: Any, run: RunLog, values: Array, until: float) -> None:
    held, shown = run.conditions.arm.held_joint, run.time < until
    for j, name in enumerate(run.conditions.joints):
        label = f"{name}{' (held)' if j + 1 == held else ''}"
        line = JOINT_LINES[j % len(JOINT_LINES)]
        panel.plot(run.time[shown], values[shown, j], label=label, **line)
    panel.set_xlim(0.0, until)


@drawn
def pendulum(run: RunLog) -> "Figure":
    """Draw angle and angular velocity of the pendulum, and what was taken for its zero.

    Args:
        run: The run.
    """
    limit, real = paper.PHI_LIMIT_DEG, seen_otherwise(run)
    inner = [interval.high for interval in paper.PHI_INTERVALS_DEG[:-1]]
    inner_dot = [interval.high for interval in paper.PHI_DOT_INTERVALS_DEG[:-1]]
    truth, to_deg = run.truth, np.rad2deg
    return _series(
        run,
        "Angle and angular velocity of the pendulum (the paper's figure 6)",
        _Row(
            "φ [°]",
            to_deg(run.phi),
            to_deg(truth.phi) if real else None,
            inner,
            (-limit, limit),
            f"failure at ±{limit:g}°",
        ),
        _Row(
            "dφ/dt [°/s]",
            to_deg(run.phi_dot),
            to_deg(truth.phi_dot) if real else None,
            inner_dot,
        ),
    )


@drawn
def flange(run: RunLog) -> "Figure":
    """Draw displacement and velocity of the flange, with the ends of the track.

    Args:
        run: The run.
    """
    limit, real = paper.X_LIMIT, seen_otherwise(run)
    inner = [interval.high for interval in paper.X_INTERVALS[:-1]]
    inner_dot = [interval.high for interval in paper.X_DOT_INTERVALS[:-1]]
    return _series(
        run,
        "Displacement and velocity of the flange along x (the paper's figure 7)",
        _Row(
            "x [m]",
            run.x,
            run.truth.x if real else None,
            inner,
            (-limit, limit),
            f"failure at ±{limit:g} m",
        ),
        _Row("dx/dt [m/s]", run.x_dot, run.truth.x_dot if real else None, inner_dot),
    )


@drawn
def encoder_zero(run: RunLog) -> "Figure":
    """Draw the error of the encoder's zero beside its estimate.

    Args:
        run: A run with an encoder.
    """
    figure = new_figure(2.5, "What the encoder shows wrongly, and what the controller takes it for")
    spans = _spans(run)
    axes: Any = figure.subplots(1, len(spans), sharey=True, squeeze=False)[0]
    error, estimated = run.conditions.zero_error, np.rad2deg(run.bias)
    for panel, (until, title) in zip(axes, spans, strict=True):
        shown = run.time < until
        if error is not None:
            panel.axhline(
                np.rad2deg(error),
                label="the error of its zero",
                color=INK,
                linewidth=1.3,
                linestyle=(0, (6, 2)),
                zorder=2.5,
            )
        panel.plot(
            run.time[shown],
            estimated[shown],
            label="estimate while balancing",
            color=SKY,
            linewidth=0.8,
        )
        panel.set_xlim(0.0, until)
        panel.set_title(title)
        panel.set_xlabel("time [s]")
    axes[0].set_ylabel("error of φ [°]")
    largest = max(float(np.max(np.abs(estimated))), abs(np.rad2deg(error or 0.0)), 0.05)
    axes[0].set_ylim(-1.2 * largest, 1.2 * largest)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _series(run: RunLog, title: str, *rows: _Row) -> "Figure":
    from matplotlib.lines import Line2D

    figure = new_figure(4.8, title)
    spans = _spans(run)
    axes: Any = figure.subplots(len(rows), len(spans), sharex="col", sharey="row", squeeze=False)
    for row, (label, seen, was, edges, limits, limit_label) in enumerate(rows):
        for column, (until, span_title) in enumerate(spans):
            panel, shown = axes[row, column], run.time < until
            panel.grid(visible=False, axis="y")
            edge_lines(panel, edges)
            limit_lines(panel, limits, limit_label if column == 0 else "")
            if was is None:
                panel.plot(run.time[shown], seen[shown], **ALONE)
            elif column == 0:
                panel.plot(run.time[shown], was[shown], label="what was", **WAS)
                panel.plot(run.time[shown], seen[shown], label="what the policy saw", **SEEN)
            else:
                panel.plot(run.time[shown], was[shown], **WAS | {"linewidth": 1.0})
            panel.set_xlim(0.0, until)
            if row == 0:
                panel.set_title(span_title)
            if row == len(rows) - 1:
                panel.set_xlabel("time [s]")
        axes[row, 0].set_ylabel(label)
        extremes = [float(np.max(np.abs(values))) for values in (seen, was) if values is not None]
        largest = max(*extremes, *(abs(value) for value in (*edges, *limits)))
        axes[row, 0].set_ylim(-1.2 * largest, 1.2 * largest)
    figure.align_ylabels(axes[:, 0])
    lines, labels = axes[0, 0].get_legend_handles_labels()
    lines.append(Line2D([], [], color=GREY, linewidth=0.6, linestyle=(0, (1, 2))))
    labels.append("edges of the boxes")
    figure.legend(lines, labels, loc="outside lower center", ncols=3)
    return figure


def _spans(run: RunLog) -> list[tuple[float, str]]:
    """Return the spans to draw, from the start until when, with their titles."""
    short, cause = paper.SECONDS_BALANCED, run.cause
    end = f"all {run.lasted:g} s" + (f", then it {how_it_ended(cause)}" if cause != LASTED else "")
    if run.lasted <= 1.5 * short:
        return [(max(run.lasted, run.conditions.h), end)]
    return [(short, f"the first {short:g} s, as long as the paper's"), (run.lasted, end)]
