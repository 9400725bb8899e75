"""Curve of a fitted swing, from the files of recording and pendulum alone."""

import numpy as np
import numpy.typing as npt

from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory
from equipoise.model.pendulum import STEPS_PER_PERIOD, Pendulum, SwingFit, swing


def fit_of(trajectory: Trajectory, pendulum: Pendulum) -> SwingFit:
    """Return the fit of a recording.

    Raises:
        RecordingError: The pendulum was not identified from this recording.
    """
    fit = pendulum.fit
    if fit is None or fit.sha256 != trajectory.sha256:
        raise RecordingError(
            f"the pendulum was identified from {fit.source if fit else 'no recording'}, "
            f"not from this {trajectory.source}; give the recording that it came from"
        )
    return fit


def fitted_curve(trajectory: Trajectory, pendulum: Pendulum) -> npt.NDArray[np.float64]:
    """Return the fitted sensor values at the times of a recording.

    Args:
        trajectory: The recording that `pendulum` was identified from.
        pendulum: The pendulum, with its fit.

    Returns:
        Angle [rad] or rate [rad/s] with zero offset or bias, shape (n,); NaN outside the fitted
        window.

    Raises:
        RecordingError: The pendulum was not identified from this recording.
    """
    fit = fit_of(trajectory, pendulum)
    begin, end = fit.window
    inside = (trajectory.time >= begin - 1e-9) & (trajectory.time <= end + 1e-9)
    # The fitted state is that of the window's start, which may lie between two samples.
    time = np.concatenate(([begin], trajectory.time[inside]))
    theta, theta_dot = np.empty_like(time), np.empty_like(time)
    h = (end - begin) / fit.periods / STEPS_PER_PERIOD
    swing(time, fit.theta, fit.theta_dot, h, pendulum.parameters(), theta, theta_dot)
    curve = np.full(trajectory.time.shape, np.nan)
    curve[inside] = (theta_dot if fit.quantity == "rate" else theta)[1:] + fit.offset
    return curve
