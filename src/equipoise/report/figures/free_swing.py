"""The paper's figure 2: the recorded free swing, the curve that was fitted to it, and what is left.

As in the paper the recording is a continuous line and the fit a dashed one.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from equipoise.model.pendulum import Pendulum, SwingFit, fit_of, fitted_curve, swing
from equipoise.report.style import INK, ORANGE, PALE, SKY, drawn, new_figure
from equipoise.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOSE_UP_PERIODS = 4.0
"""Periods of the swing in the close-up."""
PREDICTED_PERIODS = 20.0
"""Length of a predicted swing [periods]."""
STEPS_PER_PERIOD = 200
"""Steps of the integration in a period of a predicted swing."""
START = np.deg2rad(40.0)
"""Angle from which a pendulum without a recording is predicted to swing [rad]."""
BEFORE_RELEASE = 0.5
"""Periods before them, where the recording has some."""


@drawn
def free_swing(trajectory: Trajectory, pendulum: Pendulum) -> "Figure":
    """Draw a recorded swing with its fit: the whole, a close-up of its start, and the residual.

    Args:
        trajectory: The recording.
        pendulum: What was identified from it.

    Raises:
        RecordingError: The pendulum was not identified from this recording.
    """
    fit = fit_of(trajectory, pendulum)
    time, recorded = trajectory.time, np.rad2deg(trajectory.values)
    fitted = np.rad2deg(fitted_curve(trajectory, pendulum))
    rate = fit.quantity == "rate"
    name, unit = ("angular velocity", "°/s") if rate else ("angle from hanging", "°")
    symbol = "d\N{GREEK SMALL LETTER THETA}/dt" if rate else "\N{GREEK SMALL LETTER THETA}"
    figure = new_figure(4.3, "Free swing: recording and fit (the paper's figure 2)")
    axes: Any = figure.subplots(
        2, 2, sharex="col", sharey="row", width_ratios=(5, 3), height_ratios=(5, 2)
    )
    begin, end = fit.window
    period = (end - begin) / fit.periods
    close_up = (
        max(float(time[0]), begin - BEFORE_RELEASE * period),
        min(end, begin + CLOSE_UP_PERIODS * period),
    )
    for column, span in enumerate([(float(time[0]), float(time[-1])), close_up]):
        top, bottom = axes[:, column]
        shown = (time >= span[0]) & (time <= span[1])
        # A wide pale line below a thin dashed one: both are seen where they coincide.
        top.plot(time[shown], recorded[shown], color=SKY, linewidth=2.6, label="recording")
        top.plot(
            time[shown], fitted[shown], color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label="fit"
        )
        bottom.plot(time[shown], (recorded - fitted)[shown], color=INK, linewidth=0.7)
        for panel in (top, bottom):
            panel.set_xlim(*span)
            _left_out(panel, span, fit)
        bottom.set_xlabel("time [s]")
    axes[0, 0].set_title("all of it")
    axes[0, 1].set_title("the first periods")
    axes[0, 0].set_ylabel(f"{name} {symbol} [{unit}]")
    axes[1, 0].set_ylabel(f"recording \N{MINUS SIGN} fit\n[{unit}]")
    largest = float(np.nanmax(np.abs(recorded - fitted)))
    axes[1, 0].set_ylim(-1.6 * largest, 1.6 * largest)
    axes[1, 0].set_title(
        f"residual: {f'{fit.rms_deg:#.2g}'.rstrip('.')} {unit} RMS".replace(" °", "°")
    )
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if fit.window[0] > time[0]:
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        handles += [Patch(color=PALE), Line2D([], [], color=ORANGE, linewidth=1.6)]
        labels += [
            "not fitted",
            f"found free from {begin:.2f} s" if fit.release else f"from {begin:.2f} s",
        ]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@drawn
def predicted_swing(pendulum: Pendulum) -> "Figure":
    """Draw the free swing that an identified pendulum predicts, from where its recording began.

    Args:
        pendulum: The pendulum; one that was not identified from a swing starts at 40 degrees.
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
    axes.set_ylabel("angle from hanging \N{GREEK SMALL LETTER THETA} [deg]")
    frictions = [
        f"{label} {getattr(pendulum, name).value:.3g} {unit}"
        for name, label, unit in (
            ("c", "viscous", "1/s"),
            ("coulomb", "dry", "1/s²"),
            ("drag", "drag", "1/rad"),
        )
        if getattr(pendulum, name).value != 0.0
    ]
    friction = ", ".join(frictions) or "none"
    axes.set_title(f"w2 = {pendulum.w2.value:.4g} 1/s², friction: {friction}")
    return figure


def _left_out(panel: Any, span: tuple[float, float], fit: SwingFit) -> None:
    begin, end = fit.window
    for low, high in ((span[0], begin), (end, span[1])):
        if high - low > 1e-3 * (span[1] - span[0]):
            panel.axvspan(low, high, color=PALE, linewidth=0.0, zorder=0.5)
    if begin > span[0]:
        panel.axvline(begin, color=ORANGE, linewidth=1.6)
