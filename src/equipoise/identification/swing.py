r"""Identification of a pendulum from a free swing (Safeea & Neto, section 3.2, eq. 8 and fig. 2).

.. math:: \ddot\theta = -w_2 \sin\theta - c\,\dot\theta
          - f\,\mathrm{sign}\,\dot\theta - d\,|\dot\theta|\dot\theta

with theta from hanging. The frictions f and d go beyond the paper and are fitted on request. The
recording holds theta plus a zero offset, or theta_dot of a gyro plus a bias.

1. Detect the free swing from turning points and unexplained accelerations; exclude a hand on the
   pendulum and rotations over the top (`release`).
2. Fit the nonlinear equation by least squares over a growing horizon (`fit`).
3. Compute intervals with a jackknife over periods. Residuals of real swings are autocorrelated;
   errors that assume independence are up to 39 times too small.
4. Warn if the model does not explain the recording, with a remedy.
"""

from math import pi, sqrt
from typing import Final

import numpy as np

from equipoise.artefacts import Estimate
from equipoise.errors import RecordingError
from equipoise.identification import fit as fitting
from equipoise.identification.fit import COULOMB, DRAG, W2, C, FittedUnknowns, SwingRecording
from equipoise.identification.recording import Trajectory
from equipoise.identification.release import SAMPLES_PER_PERIOD, average, find_free_swing
from equipoise.model.pendulum import Pendulum, SwingFit
from equipoise.settings import Friction, IdentificationSettings

SMALL_AMPLITUDE: Final = np.deg2rad(10.0)
"""Amplitude below which a swing gives a warning [rad]: on one rig w2 was 1.4 % higher at 3.6 deg
than at 56 deg, and differed by 0.2 % from there to 149 deg."""
MODELS: Final = list(fitting.FRICTIONS)
"""Friction models, from the paper's to the richest."""
MIN_BLOCKS: Final = 8
"""Minimum number of jackknife blocks; a block is a period, or shorter in a window of fewer
periods. The scatter of fewer blocks is meaningless."""
WARNING_MISFIT: Final = 0.005
"""Misfit above which a warning is given, as a share of the amplitude: a well-modelled pivot
leaves 0.1 to 0.4 %."""
BETTER_SHARE: Final = 0.8
"""Ratio of the residuals below which a richer friction model is recommended."""


def identify(
    trajectory: Trajectory,
    settings: IdentificationSettings | None = None,
    mass: Estimate | None = None,
    length: Estimate | None = None,
) -> Pendulum:
    """Identify a pendulum from a recorded free swing.

    Args:
        trajectory: The recording, of a pivot at rest; it may start with a hand on the pendulum.
        settings: Settings of the fit.
        mass: Mass m of all rotating parts [kg], measured separately.
        length: Distance l from the axis to their centre of mass [m], measured separately. With
            both, the moment of inertia I and the friction b are computed in SI units.

    Returns:
        The pendulum, with 95 % intervals, and warnings about a poor fit.

    Raises:
        RecordingError: The recording holds no free swing of at least one period.
    """
    settings = settings or IdentificationSettings()
    rough, free = find_free_swing(trajectory)
    inside = (trajectory.time >= free.begin) & (trajectory.time <= free.end)
    time, values, w2 = trajectory.time[inside], trajectory.values[inside], free.starts[0][W2]
    is_rate, bounds = trajectory.theta is None, (0.25 * w2, 4.0 * w2)
    single = np.zeros_like(time)
    whole = SwingRecording(free.begin, time, values, single, is_rate, rough.period, bounds)
    means = average(time, values, rough.period / SAMPLES_PER_PERIOD)
    recording = whole._replace(**means._asdict())
    fit = fitting.fit_growing(recording, free.starts, settings.friction)
    residual = whole.residual(fit.unknowns)
    rms, noise = fitting.rms(residual), fitting.noise_of(residual, trajectory.resolution)
    left = fitting.misfit(rms, noise) / float(np.std(recording.values))
    if left > fitting.MAX_UNEXPLAINED:
        raise RecordingError(
            f"{trajectory.source} is not a free swing with {settings.friction} friction: the "
            f"pendulum's equation leaves {left:.0%} of the motion from {free.begin:.2f} s to "
            f"{free.end:.2f} s unexplained, expected less than {fitting.MAX_UNEXPLAINED:.0%}; "
            f"choose a free swing with --start and --end, or try --friction {MODELS[-1]}"
        )
    swing_fit = SwingFit(
        source=trajectory.source,
        sha256=trajectory.sha256,
        quantity="rate" if is_rate else "angle",
        window=(free.begin, free.end),
        release=free.release,
        samples=len(time),
        periods=float(np.ptp(time)) / rough.period,
        rms=rms,
        noise=noise,
        offset=float(fit.unknowns[fitting.OFFSET]),
        theta=float(fit.unknowns[fitting.THETA]),
        theta_dot=float(fit.unknowns[fitting.THETA_DOT]),
        settings=settings,
    )
    warnings = (*free.warnings, *_warnings(recording, whole, fit, swing_fit))
    swing_fit = swing_fit.model_copy(update={"warnings": warnings})
    return _pendulum(recording, fit, mass, length, swing_fit)


def _warnings(
    recording: SwingRecording, whole: SwingRecording, fit: FittedUnknowns, swing_fit: SwingFit
) -> list[str]:
    friction = swing_fit.settings.friction
    warnings = list[str]()
    amplitude = float(np.max(np.abs(recording.values - swing_fit.offset)))
    unexplained = fitting.misfit(swing_fit.rms, swing_fit.noise) / amplitude
    model, left = _best_friction(recording, whole, fit, swing_fit)
    if model != friction or unexplained > WARNING_MISFIT:
        cure = f"try --friction {model}, which leaves {left / swing_fit.rms:.0%} of that"
        if model == friction:
            cure = "look for play, vibration or a moving pivot, or choose another window"
        warnings.append(
            f"{friction} friction leaves {unexplained:.1%} of the amplitude unexplained, and its "
            f"numbers hold only near the amplitudes of this window; {cure}"
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
    largest = amplitude / (2.0 * pi / recording.period if recording.is_rate else 1.0)
    if largest < SMALL_AMPLITUDE:
        warnings.append(
            f"the swing stays within {np.rad2deg(largest):.2g} deg, where play and dry friction "
            "count most: the intervals do not cover that w2 may be 1 or 2 % lower in larger "
            "swings; release the pendulum from 40 to 60 deg"
        )
    return warnings


def _best_friction(
    recording: SwingRecording, whole: SwingRecording, fit: FittedUnknowns, swing_fit: SwingFit
) -> tuple[Friction, float]:
    """Return the simplest friction model that is clearly better than all simpler ones.

    Returns:
        The model with its root mean square residual; the current one if no other is better.
    """
    best, left = swing_fit.settings.friction, swing_fit.rms
    # Friction does not explain noise, and below 10 % of the warning limit the model is good enough.
    enough = 0.1 * WARNING_MISFIT * float(np.std(recording.values))
    if swing_fit.noise > BETTER_SHARE * left or left < enough:
        return best, left
    # A quarter of the means suffices to compare models.
    recording = recording.part(slice(None, None, 4 if np.any(recording.spread) else 1))
    for model in MODELS[MODELS.index(best) + 1 :]:
        fit = fitting.fit_richer(recording, model, fit)
        richer = whole.rms(fit.unknowns)
        if richer < BETTER_SHARE * left:
            best, left = model, richer
    return best, left


def _pendulum(
    recording: SwingRecording,
    fit: FittedUnknowns,
    mass: Estimate | None,
    length: Estimate | None,
    swing_fit: SwingFit,
) -> Pendulum:
    from scipy.stats import t as student

    settings, unknowns = swing_fit.settings, fit.unknowns
    blocks = max(round(swing_fit.periods), MIN_BLOCKS)
    spread = fitting.covariance(recording, fit, blocks)
    quantile = float(student.ppf(0.975, blocks - 1))
    fitted = [W2, *fitting.FRICTIONS[settings.friction]]

    def estimate(place: int, factor: float = 1.0) -> Estimate:
        width = quantile * sqrt(spread[place, place])
        source = "identified" if place in fitted else "assumed"
        value = factor * float(unknowns[place])
        return Estimate.around(value, factor * width, source).not_negative()

    inertia = friction = None
    if mass and length:
        # I = m g l / w2 and b = c I, with errors to first order.
        w2, c = float(unknowns[W2]), float(unknowns[C])
        I = mass.value * settings.g * length.value / w2
        of_ml = np.hypot(mass.half_width / mass.value, length.half_width / length.value)
        of_w2 = quantile * sqrt(spread[W2, W2]) / w2
        gradient = np.array([-c / w2, 1.0])
        of_c = quantile * np.sqrt(gradient @ spread[np.ix_([W2, C], [W2, C])] @ gradient)
        inertia, friction = (
            Estimate.around(value, I * float(width), "identified").not_negative()
            for value, width in ((I, np.hypot(of_ml, of_w2)), (c * I, np.hypot(c * of_ml, of_c)))
        )
    return Pendulum(
        w2=estimate(W2),
        k=estimate(W2, 1.0 / settings.g),
        c=estimate(C),
        coulomb=estimate(COULOMB),
        drag=estimate(DRAG),
        covariance=tuple(map(tuple, spread[: DRAG + 1, : DRAG + 1].tolist())),
        friction_model=settings.friction,
        g=settings.g,
        mass=mass,
        length=length,
        inertia=inertia,
        friction=friction,
        fit=swing_fit,
    )
