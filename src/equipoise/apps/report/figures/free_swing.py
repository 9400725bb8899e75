"""The paper's figure 2: the recorded free swing, the fitted curve, and the residual.

As in the paper the recording is a continuous line and the fit a dashed one.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from equipoise.apps.report.style import INK, ORANGE, PALE, SKY, new_figure, styled
from equipoise.identification.fitted import fit_of, fitted_curve
from equipoise.identification.recording import Trajectory
from equipoise.model.pendulum import Pendulum, SwingFit, swing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOSE_UP_PERIODS = 4.0
"""Length of the close-up after the release [periods]."""
BEFORE_RELEASE = 0.5
"""Length of the close-up before the release, if recorded [periods]."""
PREDICTED_PERIODS = 20.0
"""Length of a predicted swing [periods]."""
STEPS_PER_PERIOD = 200
"""Integration steps per period of a predicted swing."""
START = np.deg2rad(40.0)
"""Initial angle of the predicted swing of a pendulum without a recording [rad]."""


@styled()
def free_swing(trajectory: Trajectory, pendulum: Pendulum) -> "Figure":
    """Draw a recorded swing with its fit: the whole, a close-up of its start, and the residual.

    Args:
        trajectory: The recording.
        pendulum: The pendulum that was identified from it.

    Raises:
        RecordingError: The pendulum was not identified from this recording.
    """
    fit = fit_of(trajectory, pendulum)
    time, recorded = trajectory.time, np.rad2deg(trajectory.values)
    fitted = np.rad2deg(fitted_curve(trajectory, pendulum))
    rate = fit.quantity == "rate"
    name, unit = ("angular velocity dθ/dt", "°/s") if rate else ("angle from hanging θ", "°")
    figure = new_figure(4.3, "Free swing: recording and fit (the paper's figure 2)")
    axes: Any = figure.subplots(
        2, 2, sharex="col", sharey="row", width_ratios=(5, 3), height_ratios=(5, 2)
    )
    begin, end = fit.window
    period = (end - begin) / fit.periods
    first, last = float(time[0]), float(time[-1])
    low, high = begin - BEFORE_RELEASE * period, begin + CLOSE_UP_PERIODS * period
    close_up = max(first, low), min(end, high)
    dashed: Any = {"color": INK, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": "fit"}
    for column, span in enumerate([(first, last), close_up]):
        top, bottom = axes[:, column]
        shown = (time >= span[0]) & (time <= span[1])
        # A wide pale line below a thin dashed one: both stay visible where they coincide.
        top.plot(time[shown], recorded[shown], color=SKY, linewidth=2.6, label="recording")
        top.plot(time[shown], fitted[shown], **dashed)
        bottom.plot(time[shown], (recorded - fitted)[shown], color=INK, linewidth=0.7)
        for panel in (top, bottom):
            panel.set_xlim(*span)
            _shade_excluded(panel, span, fit)
        bottom.set_xlabel("time [s]")
    axes[0, 0].set_title("whole recording")
    axes[0, 1].set_title("first periods")
    axes[0, 0].set_ylabel(f"{name} [{unit}]")
    axes[1, 0].set_ylabel(f"recording \N{MINUS SIGN} fit\n[{unit}]")
    largest = float(np.nanmax(np.abs(recorded - fitted)))
    axes[1, 0].set_ylim(-1.6 * largest, 1.6 * largest)
    residual = f"{f'{fit.rms_deg:#.2g}'.rstrip('.')} {unit}".replace(" °", "°")
    axes[1, 0].set_title(f"residual: {residual} RMS")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if begin > first:
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        handles += [Patch(color=PALE), Line2D([], [], color=ORANGE, linewidth=1.6)]
        release = "release detected at" if fit.release else "from"
        labels += ["not fitted", f"{release} {begin:.2f} s"]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@styled()
def predicted_swing(pendulum: Pendulum) -> "Figure":
    """Draw the predicted free swing of an identified pendulum, from the start of its recording.

    Args:
        pendulum: The pendulum; without a recording the swing starts at 40 degrees.
    """
    start, rate = (pendulum.fit.theta, pendulum.fit.theta_dot) if pendulum.fit else (START, 0.0)
    time = np.linspace(0.0, PREDICTED_PERIODS * pendulum.period, 2000)
    theta, theta_dot = np.empty(len(time)), np.empty(len(time))
    step = pendulum.period / STEPS_PER_PERIOD
    swing(time, start, rate, step, pendulum.parameters(), theta, theta_dot)
    figure = new_figure(2.6, "Free swing of the pendulum, as identified")
    axes: Any = figure.subplots()
    axes.plot(time, np.rad2deg(theta), color=INK, linewidth=1.0)
    axes.set_xlim(0.0, float(time[-1]))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("angle from hanging θ [deg]")
    terms = (
        (pendulum.c, "viscous", "1/s"),
        (pendulum.coulomb, "dry", "1/s²"),
        (pendulum.drag, "drag", "1/rad"),
    )
    frictions = [f"{label} {e.value:.3g} {unit}" for e, label, unit in terms if e.value != 0.0]
    friction = ", ".join(frictions) or "none"
    axes.set_title(f"w2 = {pendulum.w2.value:.4g} 1/s², friction: {friction}")
    return figure


def _shade_excluded(panel: Any, span: tuple[float, float], fit: SwingFit) -> None:
    begin, end = fit.window
    for low, high in ((span[0], begin), (end, span[1])):
        if high - low > 1e-3 * (span[1] - span[0]):
            panel.axvspan(low, high, color=PALE, linewidth=0.0, zorder=0.5)
    if begin > span[0]:
        panel.axvline(begin, color=ORANGE, linewidth=1.6)
