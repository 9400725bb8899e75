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
4. If the model does not explain the recording, find one that does: with richer friction, or of a
   swing of another size, whose period varies less or more with the amplitude than that of the
   recorded angles. A wrong unit is such a case, and a spring, whose period does not vary.
"""

from collections.abc import Callable
from math import degrees, pi, radians
from typing import Final

import numpy as np

from equipoise.arguments import checked
from equipoise.arrays import Array
from equipoise.artefacts import Estimate, StrPath
from equipoise.errors import RecordingError
from equipoise.identification import fit as fitting
from equipoise.identification.fit import (
    COULOMB,
    DRAG,
    OFFSET,
    SCALE,
    THETA,
    THETA_DOT,
    W2,
    C,
    SwingRecording,
)
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
FRICTION_ADVICE: Final = "try --friction {}"
"""Advice of a friction model."""
SMALL_SWING: Final = radians(10.0)
"""Amplitude below which the period grows with the amplitude by less than 0.2 % [rad]."""
MAX_MISSED: Final = 0.15
"""Largest accepted residual in the period after the swing, as a share of the recording's standard
deviation; a hand leaves more, and a swing that friction damps or stops less."""


@checked
def identify(
    trajectory: Trajectory | StrPath,
    settings: IdentificationSettings | None = None,
    mass: Estimate | None = None,
    length: Estimate | None = None,
    show: Callable[[str], None] = lambda _: None,
) -> Pendulum:
    """Identify a pendulum from a recorded free swing.

    Args:
        trajectory: The recording, of a pivot at rest, or its file, as `read_swing` takes it; it may
            start with a hand on the pendulum.
        settings: Settings of the fit.
        mass: Mass m of all rotating parts [kg], measured separately.
        length: Distance l from the axis to their centre of mass [m], measured separately. With
            both, the moment of inertia I and the friction b are computed in SI units.
        show: Called with the progress in a few words.

    Returns:
        The pendulum, with 95 % intervals, and warnings about a poor fit.

    Raises:
        RecordingError: The recording holds no free swing of at least one period.
    """
    trajectory = trajectory if isinstance(trajectory, Trajectory) else read_swing(trajectory)
    settings = settings or IdentificationSettings()
    free = find_free_swing(trajectory)
    time, values = trajectory.time[free.part], trajectory.values[free.part]
    is_rate, w2 = trajectory.theta is None, float(free.start[W2])
    recording = SwingRecording(time, values, is_rate, free.period, w2)
    unknowns = fitting.fit_swing(recording, free.start, settings.friction, show)
    swing_fit = SwingFit(
        source=trajectory.source,
        sha256=trajectory.sha256,
        quantity="rate" if is_rate else "angle",
        window=(float(time[0]), float(time[-1])),
        release=free.release,
        samples=len(time),
        periods=float(np.ptp(time)) / free.period,
        rms=recording.rms(unknowns),
        noise=recording.noise(unknowns, trajectory.resolution),
        offset=float(unknowns[OFFSET]),
        theta=float(unknowns[THETA]),
        theta_dot=float(unknowns[THETA_DOT]),
        settings=settings,
    )
    advice = ""
    if swing_fit.unexplained > WARNING_MISFIT:
        advice = _advice(recording, unknowns, settings.friction, free.start, show)
    left = recording.misfit(unknowns, trajectory.resolution) / float(np.std(values))
    if left > fitting.MAX_UNEXPLAINED:
        raise RecordingError(
            f"{trajectory.source} is not one free swing with {settings.friction} friction: the "
            f"pendulum's equation leaves {left:.0%} of the motion from {time[0]:.2f} s to "
            f"{time[-1]:.2f} s unexplained, expected less than {fitting.MAX_UNEXPLAINED:.0%}; "
            f"{advice or 'choose a free swing with --start and --end'}"
        )
    disturbance = _disturbance(trajectory, recording, unknowns, settings.friction)
    warnings = tuple(_warnings(recording, unknowns, swing_fit, advice, disturbance))
    swing_fit = swing_fit.model_copy(update={"warnings": warnings})
    # A block is a period, or shorter in a window of few periods: the scatter of fewer blocks is
    # meaningless.
    blocks = max(round(swing_fit.periods), 8)
    spread = fitting.covariance(recording, unknowns, settings.friction, blocks)

    def estimate(place: int, factor: float = 1.0) -> Estimate:
        of_model = place in (W2, *fitting.FRICTIONS[settings.friction])
        width = factor * half_width(spread[place, place], blocks)
        value = factor * float(unknowns[place])
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


def advised_friction(fit: SwingFit) -> Friction | None:
    """Return the friction model that a warning of the fit advises; None if there is none."""
    warnings = " ".join(fit.warnings)
    return next((model for model in MODELS if FRICTION_ADVICE.format(model) in warnings), None)


def _advice(
    recording: SwingRecording,
    unknowns: Array,
    friction: Friction,
    start: Array,
    show: Callable[[str], None],
) -> str:
    """Return the advice of the simplest model that leaves less than half of the misfit, or ""."""
    enough, better = 0.5 * recording.misfit(unknowns), unknowns
    for model in MODELS[MODELS.index(friction) + 1 :]:
        show(f"trying {model} friction")
        better = fitting.fit_bounded(recording, fitting.FRICTIONS[model], better, fitting.FINE)
        if recording.misfit(better) < enough:
            return FRICTION_ADVICE.format(model)
    # A small swing is the start: its equation is linear.
    scaled = recording._replace(any_scale=True, w2=(2.0 * pi / recording.period) ** 2)
    start = start.copy()
    start[THETA_DOT if recording.is_rate else THETA] = recording.values[0] - start[OFFSET]
    start[[W2, SCALE]] = scaled.w2, SMALL_SWING / _amplitude(recording, start)
    better = fitting.fit_swing(scaled, start, MODELS[-1], show)
    if not recording.misfit(better) < enough:
        return ""
    if _amplitude(recording, better) < SMALL_SWING:
        return (
            "its period does not depend on the amplitude: a spring or a cable moves it, or the "
            "values are too large for their unit; let the pendulum swing freely"
        )
    scale = float(better[SCALE])
    factor = f"{1.0 / scale:.3g} times smaller" if scale < 1.0 else f"{scale:.3g} times larger"
    return (
        f"its period is that of a swing {factor} than recorded: check the unit (1 rad is 57.3 deg) "
        "and --counts-per-rev"
    )


def _disturbance(
    trajectory: Trajectory, recording: SwingRecording, unknowns: Array, friction: Friction
) -> str:
    """Return what ends the swing where no friction does; empty if nothing else."""
    time, end = trajectory.time, float(recording.time[-1])
    first, last = np.searchsorted(time, [end, end + recording.period])
    after = slice(first, last + 1)
    # A longer gap may hide a turning point.
    if np.max(np.diff(time[after]), initial=0.0) > 0.25 * recording.period:
        return "samples are missing"
    longer = recording._replace(time=np.append(recording.time[0], time[after]))
    for model in MODELS[MODELS.index(friction) :]:
        unknowns = fitting.fit_bounded(recording, fitting.FRICTIONS[model], unknowns, fitting.FINE)
        missed = trajectory.values[after] - longer.predict(unknowns)[1:]
        if np.mean(missed**2) < MAX_MISSED**2 * np.var(recording.values):
            return ""
    return "something touched the pendulum"


def _amplitude(recording: SwingRecording, unknowns: Array) -> float:
    """Return the amplitude at the first turning point [rad]; that of a small swing for a rate."""
    radius = recording.period / (2.0 * pi) if recording.is_rate else 1.0
    place = THETA_DOT if recording.is_rate else THETA
    return abs(float(unknowns[place] * unknowns[SCALE])) * radius


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
    recording: SwingRecording, unknowns: Array, swing_fit: SwingFit, advice: str, disturbance: str
) -> list[str]:
    friction, warnings = swing_fit.settings.friction, list[str]()
    if disturbance:
        warnings.append(
            f"{disturbance} after {swing_fit.window[1]:.2f} s: the recording is used up to there; "
            "choose another window with --start and --end"
        )
    if swing_fit.unexplained > WARNING_MISFIT:
        warnings.append(
            f"{friction} friction leaves {swing_fit.unexplained:.1%} of the amplitude unexplained, "
            "and its numbers hold only near the amplitudes of this window; "
            + (advice or "look for play, vibration or a moving pivot, or choose another window")
        )
    names = {C: "viscous", COULOMB: "Coulomb", DRAG: "quadratic"}
    warnings += [
        f"{names[place]} friction is kept at zero: the recording shows none beside the others"
        for place in fitting.at_bound(unknowns, friction)
    ]
    if swing_fit.periods < 3.0:
        warnings.append(
            f"the swing lasts {swing_fit.periods:.1f} periods only, and the intervals are rough; "
            "record ten, with less friction if it stops sooner"
        )
    # On one rig w2 was 1.4 % higher at 3.6 deg than at 56 deg, and differed by 0.2 % from there to
    # 149 deg.
    if (largest := _amplitude(recording, unknowns)) < SMALL_SWING:
        warnings.append(
            f"the swing stays within {degrees(largest):.2g} deg, where play and dry friction count "
            "most: the intervals do not cover that w2 may be 1 or 2 % lower in larger swings; "
            "release the pendulum from 40 to 60 deg"
        )
    return warnings
