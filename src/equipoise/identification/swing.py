r"""Identification of a pendulum from a free swing (Safeea & Neto, section 3.2, eq. 8 and fig. 2).

.. math:: \ddot\theta = -w_2 \sin\theta - c\,\dot\theta
          - f\,\mathrm{sign}\,\dot\theta - d\,|\dot\theta|\dot\theta

with theta from hanging. The frictions f and d go beyond the paper and are fitted on request. The
recording holds theta plus a zero offset, or theta_dot of a gyro plus a bias.

1. Detect the free swing from its turning points; exclude a hand on the pendulum and rotations over
   the top (`release`).
2. Fit the nonlinear equation by least squares over a growing horizon (`fit`).
3. Compute intervals with a jackknife over periods. Residuals of real swings are autocorrelated;
   errors that assume independence are up to 39 times too small.
4. Warn if the model does not explain the recording, with a remedy.
"""

from math import pi
from typing import Final

import numpy as np

from equipoise.arguments import checked
from equipoise.artefacts import Estimate, StrPath
from equipoise.errors import RecordingError
from equipoise.identification import fit as fitting
from equipoise.identification.fit import COULOMB, DRAG, W2, C, FittedUnknowns, SwingRecording
from equipoise.identification.least_squares import half_width
from equipoise.identification.recording import Trajectory, read_swing
from equipoise.identification.release import find_free_swing
from equipoise.model.pendulum import Pendulum, SwingFit
from equipoise.settings import Friction, IdentificationSettings

MODELS: Final = list(fitting.FRICTIONS)
"""Friction models, from the paper's to the richest."""
WARNING_MISFIT: Final = 0.005
"""Share of the amplitude left unexplained above which a warning is given: a well-modelled pivot
leaves 0.1 to 0.4 %."""


@checked
def identify(
    trajectory: Trajectory | StrPath,
    settings: IdentificationSettings | None = None,
    mass: Estimate | None = None,
    length: Estimate | None = None,
) -> Pendulum:
    """Identify a pendulum from a recorded free swing.

    Args:
        trajectory: The recording, of a pivot at rest, or its file, as `read_swing` takes it; it may
            start with a hand on the pendulum.
        settings: Settings of the fit.
        mass: Mass m of all rotating parts [kg], measured separately.
        length: Distance l from the axis to their centre of mass [m], measured separately. With
            both, the moment of inertia I and the friction b are computed in SI units.

    Returns:
        The pendulum, with 95 % intervals, and warnings about a poor fit.

    Raises:
        RecordingError: The recording holds no free swing of at least one period.
    """
    trajectory = trajectory if isinstance(trajectory, Trajectory) else read_swing(trajectory)
    settings = settings or IdentificationSettings()
    free = find_free_swing(trajectory)
    time, values = trajectory.time[free.part], trajectory.values[free.part]
    is_rate, w2 = trajectory.theta is None, float(free.starts[0][W2])
    recording = SwingRecording(time, values, is_rate, free.period, w2)
    fit = fitting.fit_growing(recording, free.starts, settings.friction)
    left = recording.misfit(fit.unknowns, trajectory.resolution) / float(np.std(values))
    if left > fitting.MAX_UNEXPLAINED:
        raise RecordingError(
            f"{trajectory.source} is not one free swing with {settings.friction} friction: the "
            f"pendulum's equation leaves {left:.0%} of the motion from {time[0]:.2f} s to "
            f"{time[-1]:.2f} s unexplained, expected less than {fitting.MAX_UNEXPLAINED:.0%}; "
            f"choose a free swing with --start and --end, or try --friction {MODELS[-1]}"
        )
    swing_fit = SwingFit(
        source=trajectory.source,
        sha256=trajectory.sha256,
        quantity="rate" if is_rate else "angle",
        window=(float(time[0]), float(time[-1])),
        release=free.release,
        samples=len(time),
        periods=float(np.ptp(time)) / free.period,
        rms=recording.rms(fit.unknowns),
        noise=recording.noise(fit.unknowns, trajectory.resolution),
        offset=float(fit.unknowns[fitting.OFFSET]),
        theta=float(fit.unknowns[fitting.THETA]),
        theta_dot=float(fit.unknowns[fitting.THETA_DOT]),
        settings=settings,
    )
    warnings = tuple(_warnings(recording, fit, swing_fit, free.touched))
    swing_fit = swing_fit.model_copy(update={"warnings": warnings})
    # A block is a period, or shorter in a window of few periods: the scatter of fewer blocks is
    # meaningless.
    blocks = max(round(swing_fit.periods), 8)
    spread = fitting.covariance(recording, fit, blocks)

    def estimate(place: int, factor: float = 1.0) -> Estimate:
        of_model = place in (W2, *fitting.FRICTIONS[settings.friction])
        width = factor * half_width(spread[place, place], blocks)
        value = factor * float(fit.unknowns[place])
        source = "identified" if of_model else "assumed"
        return Estimate.around(value, width, source).not_negative()

    pendulum = Pendulum(
        w2=estimate(W2),
        k=estimate(W2, 1.0 / settings.g),
        c=estimate(C),
        coulomb=estimate(COULOMB),
        drag=estimate(DRAG),
        covariance=tuple(map(tuple, spread[: DRAG + 1, : DRAG + 1].tolist())),
        friction_model=settings.friction,
        g=settings.g,
        fit=swing_fit,
    )
    return _weighed(pendulum, mass, length, blocks) if mass and length else pendulum


def richer_friction(fit: SwingFit) -> Friction | None:
    """Return the friction model to try after a poor fit; None after a good one, or the richest."""
    richer = MODELS[MODELS.index(fit.settings.friction) + 1 :]
    return richer[0] if richer and fit.unexplained > WARNING_MISFIT else None


def _weighed(pendulum: Pendulum, mass: Estimate, length: Estimate, blocks: int) -> Pendulum:
    """Return a pendulum with I = m g l / w2 and b = c I, with errors to first order."""
    w2, c = pendulum.w2.value, pendulum.c.value
    I = mass.value * pendulum.g * length.value / w2
    of_ml = np.hypot(mass.half_width / mass.value, length.half_width / length.value)
    of_I = np.hypot(of_ml, pendulum.w2.half_width / w2)
    gradient, spread = np.array([-c / w2, 1.0]), np.array(pendulum.covariance)[:2, :2]
    of_b = np.hypot(c * of_ml, half_width(float(gradient @ spread @ gradient), blocks))
    inertia, friction = (
        Estimate.around(value, I * float(width), "identified").not_negative()
        for value, width in ((I, of_I), (c * I, of_b))
    )
    known = {"mass": mass, "length": length, "inertia": inertia, "friction": friction}
    return pendulum.model_copy(update=known)


def _warnings(
    recording: SwingRecording, fit: FittedUnknowns, swing_fit: SwingFit, touched: float | None
) -> list[str]:
    friction, warnings = swing_fit.settings.friction, list[str]()
    if touched is not None:
        warnings.append(
            f"something touched the pendulum at about {touched:.2f} s, or samples are missing: the "
            "recording is used up to there; choose another window with --start and --end"
        )
    if swing_fit.unexplained > WARNING_MISFIT:
        richer = richer_friction(swing_fit)
        warnings.append(
            f"{friction} friction leaves {swing_fit.unexplained:.1%} of the amplitude unexplained, "
            "and its numbers hold only near the amplitudes of this window; "
            f"{f'try --friction {richer}, ' if richer else ''}look for play, vibration or a moving "
            "pivot, or choose another window"
        )
    names = {C: "viscous", COULOMB: "Coulomb", DRAG: "quadratic"}
    warnings += [
        f"{names[place]} friction is kept at zero: the recording shows none beside the others"
        for place in fit.bound
    ]
    if swing_fit.periods < 3.0:
        warnings.append(
            f"the swing lasts {swing_fit.periods:.1f} periods only, and the intervals are rough; "
            "record ten"
        )
    # On one rig w2 was 1.4 % higher at 3.6 deg than at 56 deg, and differed by 0.2 % from there to
    # 149 deg.
    largest = np.rad2deg(
        swing_fit.amplitude / (2.0 * pi / recording.period if recording.is_rate else 1.0)
    )
    if largest < 10.0:
        warnings.append(
            f"the swing stays within {largest:.2g} deg, where play and dry friction count most: "
            "the intervals do not cover that w2 may be 1 or 2 % lower in larger swings; release "
            "the pendulum from 40 to 60 deg"
        )
    return warnings
