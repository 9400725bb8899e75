r"""A recorded free swing becomes a pendulum (Safeea & Neto, section 3.2, equation 8 and figure 2).

.. math:: \ddot\theta = -w_2 \sin\theta - c\,\dot\theta
          - f\,\mathrm{sign}\,\dot\theta - d\,|\dot\theta|\dot\theta

with theta from hanging. The frictions f and d go beyond the paper and are fitted on request. What
was recorded is theta plus a zero offset, or from a gyro theta_dot plus a bias.

1. Where does it swing freely? Turning points, then the acceleration that gravity and friction do
   not explain: a hand on the pendulum is left out (`release`).
2. Least squares against the nonlinear equation over a growing horizon (`fit`).
3. Intervals from a jackknife: how far does the estimate move when one period is left out?
   Residuals of real swings last for many samples; errors that take them for independent are up to
   39 times too small.
4. Where the model does not explain the recording, a warning says so, and what to try.
"""

from math import sqrt

import numpy as np

from equipoise.artefacts import Estimate
from equipoise.errors import RecordingError
from equipoise.identification.fit import (
    COULOMB,
    DRAG,
    FRICTIONS,
    OFFSET,
    THETA,
    THETA_DOT,
    W2,
    Array,
    C,
    Fit,
    Recording,
    covariance,
    fit_bounded,
    fit_growing,
    rms,
)
from equipoise.identification.release import FreeSwing, find_free_swing, find_oscillation
from equipoise.model.pendulum import Pendulum, SwingFit
from equipoise.settings import Friction, IdentificationSettings
from equipoise.trajectory import Trajectory

__all__ = ["identify"]


def identify(
    trajectory: Trajectory,
    settings: IdentificationSettings | None = None,
    mass: Estimate | None = None,
    length: Estimate | None = None,
) -> Pendulum:
    """Identify a pendulum from a recorded free swing.

    Args:
        trajectory: The recording; a hand may still be on the pendulum at its start.
        settings: How to fit.
        mass: Mass m of all that rotates [kg], measured apart.
        length: Distance l from the axis to its centre of mass [m], measured apart; with both, the
            moment of inertia I and the friction b are given in SI units.

    Returns:
        The pendulum, with 95 % intervals and warnings where the model explains it badly.

    Raises:
        RecordingError: The recording holds no free swing of at least one period.
    """
    settings = settings or IdentificationSettings()
    if trajectory.x_ddot is not None and np.any(trajectory.x_ddot != 0.0):
        raise RecordingError(
            f"{trajectory.source}: the pivot accelerates by up to "
            f"{np.max(np.abs(trajectory.x_ddot)):.3g} m/s^2, expected a pivot at rest; "
            "record a free swing on a fixed pivot"
        )
    rough = find_oscillation(trajectory, settings)
    free = find_free_swing(trajectory, rough, settings)
    recording = Recording(
        time=trajectory.time[free.keep],
        values=trajectory.values[free.keep],
        is_rate=trajectory.theta is None,
        h=rough.period / settings.steps_per_period,
        w2_range=(0.25 * free.w2, 4.0 * free.w2),
    )
    start = np.array([free.w2, free.c, 0.0, 0.0, free.theta, free.theta_dot, free.offset])
    fit = fit_growing(recording, start, rough.period, settings)
    residual = recording.residual(fit.unknowns)
    periods = float(np.ptp(recording.time)) / rough.period
    swing_fit = SwingFit(
        source=trajectory.source,
        sha256=trajectory.sha256,
        quantity="rate" if recording.is_rate else "angle",
        window=(float(recording.time[0]), float(recording.time[-1])),
        release=free.release,
        samples=len(recording.time),
        periods=periods,
        rms=rms(residual),
        noise=_noise(residual, trajectory.resolution),
        offset=float(fit.unknowns[OFFSET]),
        theta=float(fit.unknowns[THETA]),
        theta_dot=float(fit.unknowns[THETA_DOT]),
        settings=settings,
    )
    _refuse_unexplained(recording, swing_fit)
    warnings = _warnings(recording, fit, free, swing_fit)
    blocks = max(round(periods), settings.least_blocks)
    return _pendulum(
        fit.unknowns,
        covariance(recording, fit, blocks),
        blocks,
        mass,
        length,
        swing_fit.model_copy(update={"warnings": warnings}),
    )


def _refuse_unexplained(recording: Recording, swing_fit: SwingFit) -> None:
    settings, spread = swing_fit.settings, float(np.std(recording.values))
    left = _misfit(swing_fit) / spread
    if left > settings.unexplained:
        begin, end = swing_fit.window
        raise RecordingError(
            f"{swing_fit.source} is not a free swing: the pendulum's equation leaves {left:.0%} of "
            f"the motion from {begin:.2f} s to {end:.2f} s unexplained, expected less than "
            f"{settings.unexplained:.0%}; choose a free swing with --start and --end"
        )


def _misfit(swing_fit: SwingFit) -> float:
    """Return the part of the residual that is not noise, in the recording's unit."""
    return sqrt(max(swing_fit.rms**2 - swing_fit.noise**2, 0.0))


def _noise(residual: Array, resolution: float) -> float:
    """Return the part of a residual that is new in each sample; at least the sensor's step."""
    return max(float(np.std(np.diff(residual))) / sqrt(2.0), resolution / sqrt(12.0))


def _warnings(
    recording: Recording, fit: Fit, free: FreeSwing, swing_fit: SwingFit
) -> tuple[str, ...]:
    settings, left = swing_fit.settings, swing_fit.rms
    unit = "deg/s" if recording.is_rate else "deg"
    residual = f"{np.rad2deg(left):.3g} {unit} RMS"
    better = _better_friction(recording, fit, left, settings)
    warnings = list(free.warnings)
    amplitude = float(np.max(np.abs(recording.values - swing_fit.offset)))
    misfit = _misfit(swing_fit) / amplitude
    if misfit > settings.misfit_share:
        warnings.append(
            f"{settings.friction} friction does not explain the recording: it leaves {residual}, "
            f"{misfit:.1%} of the amplitude, where the noise is "
            f"{np.rad2deg(swing_fit.noise):.2g} {unit}; "
            + (
                f"try --friction {better[0]}"
                if better
                else "no friction model here does better: look for play, vibration or a pivot "
                "that moves, or choose another window with --start and --end"
            )
        )
    if better:
        warnings.append(
            f"--friction {better[0]} leaves {np.rad2deg(better[1]):.3g} {unit} RMS instead of "
            f"{residual}: the numbers of {settings.friction} friction hold only near the "
            "amplitudes of this window"
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
    return tuple(warnings)


def _better_friction(
    recording: Recording, fit: Fit, left: float, settings: IdentificationSettings
) -> tuple[Friction, float] | None:
    """Return the simplest richer friction model that leaves clearly less, and what it leaves."""
    best: tuple[Friction, float] | None = None
    models = list(FRICTIONS)
    for model in models[models.index(settings.friction) + 1 :]:
        richer = fit_bounded(recording, model, fit.unknowns)
        its = rms(recording.residual(richer.unknowns))
        if its < settings.better_share * left:
            best, left = (model, its), its
    return best


def _pendulum(
    unknowns: Array,
    spread: Array,
    blocks: int,
    mass: Estimate | None,
    length: Estimate | None,
    swing_fit: SwingFit,
) -> Pendulum:
    from scipy.stats import t as student

    settings = swing_fit.settings
    quantile = float(student.ppf(0.975, blocks - 1))
    fitted = [W2, *FRICTIONS[settings.friction]]

    def estimate(place: int, factor: float = 1.0) -> Estimate:
        width = quantile * sqrt(spread[place, place])
        return _positive(
            factor * float(unknowns[place]),
            factor * width,
            "identified" if place in fitted else "assumed",
        )

    inertia = friction = None
    if mass and length:
        # I = m g l / w2 and b = c I, with errors to first order.
        w2, c = float(unknowns[W2]), float(unknowns[C])
        I = mass.value * settings.g * length.value / w2
        apart = np.hypot(_width(mass) / mass.value, _width(length) / length.value)
        of_w2 = quantile * sqrt(spread[W2, W2]) / w2
        gradient = np.array([-c / w2, 1.0])
        of_c = quantile * np.sqrt(gradient @ spread[np.ix_([W2, C], [W2, C])] @ gradient)
        inertia = _positive(I, I * float(np.hypot(apart, of_w2)))
        friction = _positive(c * I, I * float(np.hypot(c * apart, of_c)))
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


def _positive(value: float, width: float, source: str = "identified") -> Estimate:
    """Return an estimate of what cannot be negative."""
    return Estimate.model_validate(
        {"value": value, "low": max(value - width, 0.0), "high": value + width, "source": source}
    )


def _width(estimate: Estimate) -> float:
    return (estimate.high - estimate.low) / 2.0
