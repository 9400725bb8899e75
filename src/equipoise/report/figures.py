"""Figures of the paper and of the report, drawn from saved values only.

Every function returns a matplotlib figure; `equipoise.report.style.save` writes it as SVG and PNG.
"""

from itertools import pairwise
from math import inf
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.policy import TabularPolicy
from equipoise.identification.recording import Trajectory, fitted_curve
from equipoise.log.motion import Motion
from equipoise.log.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.outcomes import Outcome, Phase
from equipoise.report import style
from equipoise.report.style import edges, new_figure, plain, styled, typeset
from equipoise.simulation.evaluation import Evaluation, TrialResults

TRIAL_LINES: Final[tuple[dict[str, Any], ...]] = (
    {"color": style.BLUE, "linewidth": 3.2},
    {"color": style.INK, "linewidth": 1.3, "linestyle": (0, (5, 2))},
    {"color": style.ORANGE, "linewidth": 1.6, "linestyle": (0, (1, 1.5))},
    {"color": style.VERMILION, "linewidth": 1.3, "linestyle": (0, (6, 1.5, 1, 1.5))},
    {"color": style.GREEN, "linewidth": 1.0},
    {"color": style.PURPLE, "linewidth": 1.3, "linestyle": (0, (3, 1, 1, 1, 1, 1))},
)
"""Lines of the policy and the baselines; the policy's line, the first, is wide below the others."""
JOINT_COLOURS: Final = (
    *(style.SKY, style.VERMILION, style.GREY, style.GREEN),
    *(style.ORANGE, style.PURPLE, style.INK),
)
"""Colours of the joints from the base on."""


@styled()
def free_swing(trajectory: Trajectory, pendulum: Pendulum) -> Figure:
    """Draw a recorded swing with its fit, and the residual.

    As in the paper's figure 2 the recording is a continuous line and the fit a dashed one.

    Args:
        trajectory: The recording.
        pendulum: The pendulum that was identified from it.

    Raises:
        RecordingError: The pendulum was not identified from this recording.
    """
    time, recorded = trajectory.time, np.rad2deg(trajectory.values)
    fitted = np.rad2deg(fitted_curve(trajectory, pendulum))
    fit: Any = pendulum.fit  # there is one, or no curve
    rate = trajectory.theta is None
    name, unit = ("angular velocity dθ/dt", "°/s") if rate else ("angle from hanging θ", "°")
    figure = new_figure(4.3, "Free swing: recording and fit (the paper's figure 2)")
    axes: Any = figure.subplots(2, 1, sharex=True, height_ratios=(5, 2))
    top, bottom = axes
    # A wide pale line below a thin dashed one: both stay visible where they coincide.
    top.plot(time, recorded, color=style.SKY, linewidth=2.6, label="recording")
    top.plot(time, fitted, color=style.INK, linestyle=(0, (4, 2)), label="fit")
    bottom.plot(time, recorded - fitted, color=style.INK, linewidth=0.7)
    first, last = float(time[0]), float(time[-1])
    for panel in axes:
        panel.set_xlim(first, last)
        for low, high in ((first, fit.window[0]), (fit.window[1], last)):
            panel.axvspan(low, max(low, high), color=style.PALE, linewidth=0.0, zorder=0.5)
    top.set_title("grey: not fitted")
    top.set_ylabel(f"{name} [{unit}]")
    bottom.set_title(f"{np.rad2deg(fit.rms):.2g} {unit} RMS".replace(" °", "°"))
    bottom.set_ylabel(f"residual [{unit}]")
    bottom.set_xlabel("time [s]")
    figure.legend(*top.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


@styled()
def learning_curve(policy: TabularPolicy) -> Figure:
    """Draw the mean duration of the training episodes, and mark the selected table.

    Args:
        policy: The policy, with its learning curve.
    """
    # Episodes run in parallel, and few of them end between two points: average over several.
    stride = max(1, len(policy.learning_curve) // 100)
    points = policy.learning_curve[stride - 1 :: stride]
    episodes = np.array([0, *(point.episodes for point in points)], dtype=np.float64)
    seconds = policy.h * np.array([0, *(point.steps for point in points)])
    figure, limit = new_figure(2.6, "Learning curve"), policy.settings.learning.episode_duration
    axes: Any = figure.subplots()
    axes.stairs(np.diff(seconds) / np.diff(episodes), episodes, baseline=None, color=style.INK)
    for best in policy.checkpoints[:1]:
        axes.axvline(best.episodes, color=style.ORANGE, label=f"kept: episode {best.episodes:,}")
        figure.legend(loc="outside lower center")
    axes.set_title(f"training episodes, truncated after {limit:g} s")
    axes.set_ylabel("mean duration [s]")
    axes.set_ylim(0.0, 1.05 * limit)
    axes.set_xlabel("episodes")
    axes.set_xlim(0, policy.episodes)
    return figure


@styled()
def survival(evaluation: Evaluation) -> Figure:
    """Draw survival against time, and the final survival rates with their intervals.

    Args:
        evaluation: Trials of a policy, and of the baselines under the same conditions.
    """
    results = [evaluation.results, *evaluation.baselines]
    figure = new_figure(3.6, "Survival of the policy and the baselines")
    axes: Any = figure.subplots(1, 2, width_ratios=(5, 3))
    left, right = axes
    begin = 0.8 * min(min(policy.survival) for policy in results)
    for row, (policy, line) in enumerate(zip(results, TRIAL_LINES, strict=False)):
        curve = _survival_curve(policy, begin, evaluation.duration)
        left.plot(*curve, drawstyle="steps-post", label=plain(policy.name), **line)
        summary = policy.summary()
        rate, (low, high) = 100.0 * summary.rate, (100.0 * end for end in summary.interval)
        right.plot([low, high], [row, row], color=line["color"], linewidth=2.2)
        right.plot(rate, row, "o", color=line["color"], markeredgecolor=style.INK)
        text, side = f"{rate:.3g} % [{low:.3g}, {high:.3g}]", "left" if rate < 50.0 else "right"
        where: Any = {"textcoords": "offset points", "ha": side, "fontsize": 7.5}
        right.annotate(text, (0.5 * (low + high), row), (0, 6), **where)
    left.set_xscale("log")
    left.set_xlim(begin, evaluation.duration)
    ticks = [t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60) if begin <= t <= evaluation.duration]
    left.set_xticks(ticks, [f"{t:g}" for t in ticks])
    left.minorticks_off()
    left.set_ylim(-4.0, 104.0)
    left.set_xlabel("time since the release [s]")
    left.set_ylabel("trials surviving [%]")
    left.set_title(f"{len(evaluation.results.survival)} trials each, the same conditions for all")
    label = f"the paper's run on the real arm, {paper.SECONDS_BALANCED:g} s"
    left.axvline(paper.SECONDS_BALANCED, label=label, color=style.GREY, zorder=0.9)
    right.set_yticks(range(len(results)), [plain(policy.name) for policy in results])
    right.set_ylim(len(results) - 0.5, -0.7)
    right.set_xlim(-4.0, 104.0)
    right.grid(visible=False, axis="y")
    right.set_xlabel("fraction [%] with 95 % interval")
    right.set_title(f"survived {evaluation.duration:g} s")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _survival_curve(results: TrialResults, begin: float, end: float) -> tuple[Array, Array]:
    """Return the times [s] and the fraction of trials that survive beyond each [%]."""
    trials = zip(results.survival, results.outcomes, strict=True)
    falls = np.sort([survival for survival, cause in trials if cause != Outcome.SURVIVED])
    surviving = 100.0 * (1.0 - np.arange(len(falls) + 1) / len(results.survival))
    return np.concatenate(([begin], falls, [end])), np.append(surviving, surviving[-1])


@styled()
def run_figure(recipe: str, run: RunLog, beside: RunLog) -> Figure:
    """Draw a run as in the paper's figures 4 to 7: the first 5 s, as there.

    The rows are command, joints, pendulum and flange, with the edges of the boxes and the failure
    limits. The true state is drawn beside the policy's observation.

    Args:
        recipe: Title: the recipe of the policy.
        run: A simulated run with a policy.
        beside: The run of the figure beside it, which gets the same axes.

    Raises:
        RecordingError: No policy ran.
    """
    run.require_balancing()
    until, boxes = paper.SECONDS_BALANCED, run.conditions.settings.boxes
    # The true state is wide and pale below the thin dark observation, distinct in grey too.
    true_line: Any = {"color": style.SKY, "linewidth": 2.4}
    observed_line: Any = {"color": style.INK, "linewidth": 0.8}
    rows = (
        ("φ [°]", boxes.phi_deg, paper.PHI_LIMIT_DEG),
        ("dφ/dt [°/s]", boxes.phi_dot_deg, None),
        ("x [m]", boxes.x, paper.X_LIMIT),
        ("dx/dt [m/s]", boxes.x_dot, None),
    )
    time = run.time[run.time < until]
    edges = np.append(time, time[-1] + run.conditions.h)
    figure = new_figure(8.8, f"{recipe}: {run.outcome} after {run.survival:g} s")
    axes: Any = figure.subplots(6, 1, sharex=True, height_ratios=(3, 2, 2, 2, 2, 2))
    axes[0].stairs(run.ticks.u[run.time < until], edges, baseline=None, **observed_line)
    axes[0].set_yticks(paper.ACTIONS, [typeset(f"{action:+g}") for action in paper.ACTIONS])
    axes[0].set_ylabel("u [m/s²]")
    joints, *states = _curves(run, until)
    for joint, (name, moved) in enumerate(zip(run.conditions.joints, joints.T, strict=True)):
        axes[1].plot(time, moved, color=JOINT_COLOURS[joint % 7], label=plain(name))
    axes[1].set_ylabel("joints, change [°]")
    for panel, (label, inner, limit), curves in zip(axes[2:], rows, states, strict=True):
        panel.grid(visible=False, axis="y")
        for edge in inner:
            panel.axhline(edge, color=style.GREY, linewidth=0.6, linestyle=(0, (1, 2)))
        for end in (-limit, limit) if limit else ():
            panel.axhline(end, color=style.INK, linewidth=1.0, linestyle=(0, (6, 2)))
        panel.plot(time, curves[:, 0], label="true state", **true_line)
        panel.plot(time, curves[:, 1], label="observation", **observed_line)
        panel.set_ylabel(label)
    for panel, curves in zip(axes[1:], _curves(beside, until), strict=True):
        panel.update_datalim([(0.0, curves.min()), (0.0, curves.max())])
        panel.autoscale_view()
    for panel in axes if run.survival < until else ():
        panel.axvline(run.survival, color=style.VERMILION)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(0.0, until)
    figure.align_ylabels(axes)
    names: Any = [panel.get_legend_handles_labels() for panel in axes[1:3]]
    handles, labels = (names[0][part] + names[1][part] for part in (0, 1))
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    return figure


def _curves(run: RunLog, until: float) -> list[Array]:
    """Return what the panels below the command show before a time [s], each of shape (n, curves).

    They are the change of the joints [deg], then the true and the observed phi [deg], phi_dot
    [deg/s], x [m] and x_dot [m/s].
    """
    shown, true, seen, deg = run.time < until, run.truth, run.ticks, np.rad2deg
    return [
        deg(seen.q - seen.q[0])[shown],
        np.column_stack((deg(true.phi), deg(seen.phi)))[shown],
        np.column_stack((deg(true.phi_dot), deg(seen.phi_dot)))[shown],
        np.column_stack((true.x, seen.x))[shown],
        np.column_stack((true.x_dot, seen.x_dot))[shown],
    ]


@styled()
def swing_up(run: RunLog) -> Figure:
    """Draw a swing-up: the pendulum in the phase plane; angle, flange and command against time.

    Args:
        run: A simulated run that began with a hanging pendulum.

    Raises:
        RecordingError: The run has no ticks.
    """
    motion = Motion.of(run)
    first, h = len(run.phase_ticks(Phase.SWINGING_UP)), run.conditions.h
    taken, last = first * h, first + round(2.0 / h)  # the first 2 s of the policy
    time = motion.time - motion.time[0]
    phi, phi_dot = np.rad2deg(motion.phi), np.rad2deg(run.tables["truth"]["phi_dot"])
    title = f"handed over after {taken:.2f} s" if len(run.ticks) else str(run.outcome)
    figure = new_figure(3.8, f"Swing-up: {title}")
    rows: Any = {"φ [°]": phi, "x [m]": motion.x, "u [m/s²]": motion.u}
    panels: Any = figure.subplot_mosaic([["plane", name] for name in rows], width_ratios=(3, 4))
    plane = panels.pop("plane")
    angle = np.linspace(phi.min(), phi.max(), 200)
    upright = np.sqrt(2.0 * run.conditions.pendulum.w2 * (1.0 - np.cos(np.deg2rad(angle))))
    plane.plot(angle, np.rad2deg(np.column_stack((-upright, upright))), **TRIAL_LINES[2])
    for label, color, part in (
        ("swing-up", style.BLUE, slice(first + 1)),
        ("policy", style.INK, slice(first, last)),
    ):
        plane.plot(phi[part], phi_dot[part], color=color, label=label)
        for name, panel in panels.items():
            panel.plot(time[part], rows[name][part], color=color)
    plane.plot(phi[first : first + 1], phi_dot[first : first + 1], "o", color=style.VERMILION)
    plane.set_title("dotted: energy of the pendulum at rest upright")
    plane.set_xlabel("φ [°]")
    plane.set_ylabel("dφ/dt [°/s]")
    plane.xaxis.set_major_locator(MultipleLocator(90.0))
    panels["φ [°]"].yaxis.set_major_locator(MultipleLocator(180.0))
    for name, panel in panels.items():
        panel.set_ylabel(name)
        panel.axvline(taken, color=style.VERMILION)
    panels["u [m/s²]"].set_xlabel("time [s]")
    figure.align_ylabels(list(panels.values()))
    figure.legend(*plane.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


@styled()
def policy_picture(policy: TabularPolicy) -> Figure:
    """Draw the commanded acceleration per box: a panel per x and x_dot, with phi and phi_dot axes.

    Boxes without a number were never visited in the training.

    Args:
        policy: The policy.
    """
    boxes = policy.settings.boxes
    shape = boxes.shape
    u = policy.u_of_box.reshape(shape)
    trained = np.any(np.array(policy.visits) > 0, axis=1).reshape(shape)
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
                pen = style.INK if abs(u[i, j, k, m]) < 0.6 * largest else "white"
                command: Any = {"ha": "center", "va": "center", "color": pen, "fontsize": size}
                text = typeset(f"{u[i, j, k, m]:+g}")
                panel.text(i + 0.5, j + 0.5, text, in_layout=False, **command)
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
