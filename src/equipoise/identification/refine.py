r"""Regression of the pendulum's equation on a log of balancing, with a moving pivot.

.. math:: \ddot\varphi = w_2 \sin\varphi - k\,\ddot x \cos\varphi - c\,\dot\varphi
          - f\,\mathrm{sign}\,\dot\varphi

phi from upright and x, the *measured* pivot, positive the same way (Safeea & Neto, section 3.2).
The equation is linear in its parameters. Two additional terms model errors of the log: the zero
error of the encoder and the latency of x. The equation does not hold for a flange that tilts or
rises: add the tilt to phi; vertical motion is not modelled.

The log holds no accelerations. Direct differentiation amplifies the encoder's steps beyond the
motion of a balanced pendulum. Smoothing first removes different parts of the motion from phi and x
than from sin phi, and biases w2 and k by some percent. The weak form avoids both: the equation is
multiplied by a smooth window and integrated. Cubic splines through the samples give every term; by
integration by parts, their second derivatives under the window equal the samples under its second
derivative. All terms see the same window.

While a policy balances, phi and x_ddot are correlated, and separate estimates of w2 and k are poor.
A rigid pendulum has k = w2 / g; with this constraint a log of a minute gives the inertia to 0.1 %.
"""

from math import sqrt
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import Estimate, Value
from equipoise.errors import RecordingError
from equipoise.identification.jackknife import blocks_of_time, jackknife
from equipoise.model.pendulum import Pendulum
from equipoise.settings import GRAVITY, PlantSettings

Array = npt.NDArray[np.float64]

WINDOW: Final = 0.3
"""Length of the smooth window [s]. Shorter windows pass the encoder's steps; longer windows lose
the fast part of the motion, and dry friction with it."""
RATE_WINDOW: Final = 0.06
"""Length of the window for the sign of the rate [s]. Longer windows miss short swings, and half of
the dry friction with them; shorter windows pass the encoder's steps."""
POINTS_PER_SAMPLE: Final = 4
"""Points of the splines per sample: enough to integrate a window to rounding error."""
BLOCK_DURATION: Final = 2.0
"""Duration of a jackknife block [s]: longer than the correlation of the motion."""
MIN_BLOCKS: Final = 8
"""Minimum number of blocks; the scatter of fewer blocks is meaningless."""
GAP_RATIO: Final = 3.5
"""Ratio of a sampling step to the usual one above which the step is a gap; gaps are left out."""
MAX_UNEXPLAINED: Final = 0.7
"""Largest accepted unexplained share of the acceleration; more indicates another motion. A pendulum
that moves by two counts of its encoder leaves 0.5."""
MAX_LATENESS: Final = 0.002
"""Time shift between x and phi above which a warning is given [s]."""
ROUGH_FIT: Final = 0.1
"""Unexplained share above which friction is indistinguishable from noise. Balancing with a table
leaves 0.01."""
MIRRORED_RATIO: Final = 0.5
"""Ratio of the unexplained shares with x negated and as given, below which phi and x count in
opposite directions."""


class ClosedLoopFit(Value):
    """Pendulum parameters from a closed-loop log, with 95 % intervals."""

    w2: Estimate
    """Gravity over inertia, m g l / I [1/s^2]."""
    k: Estimate
    """Coupling to the pivot's acceleration, m l / I [1/m]."""
    c: Estimate
    """Viscous friction over inertia [1/s]."""
    coulomb: Estimate
    """Coulomb friction over inertia [1/s^2]."""
    friction: Estimate
    """Viscous friction with the same dissipation as both, c + coulomb / rate [1/s]; its interval is
    narrower than that of either."""
    zero: Estimate
    """Zero error of the encoder: phi as read minus true [rad]."""
    late: Estimate
    """Latency of x relative to phi [s]."""
    rate: float
    """Mean square of phi_dot over its mean absolute value [rad/s]."""
    tied: bool
    """Whether k was constrained to w2 / g."""
    g: float
    """Acceleration of gravity [m/s^2]."""
    derivatives: Literal["weak"] = "weak"
    """Method of differentiation: the weak form."""
    duration: float
    """Length of the log [s]."""
    samples: int
    """Number of samples of the log."""
    blocks: int
    """Number of jackknife blocks."""
    unexplained: float
    """Root mean square residual over the root mean square acceleration."""
    warnings: tuple[str, ...] = ()
    """Warnings about a poor log, with remedies."""


class ParameterChange(Value):
    """Significant change of a parameter between an identification and a log."""

    name: Literal["w2", "k", "c"]
    """Name of the parameter."""
    before: Estimate
    """Identified value."""
    now: Estimate
    """Value from the log."""
    z: float
    """Difference in combined standard deviations."""

    @property
    def text(self) -> str:
        """One-line description of the change."""
        unit, meaning = _MEANINGS[self.name]
        physical = self.now.not_negative()
        before, now = self.before.value, physical.value
        share = f" by {now / before - 1.0:+.1%}" if before else ""
        return (
            f"{self.name} moved{share}, from {_readable(self.before)} to {_readable(physical)} "
            f"{unit} (95 % intervals, z = {self.z:.1f}): {meaning}"
        )


_MEANINGS: Final = {
    "w2": ("1/s^2", "mass, length or inertia of the pendulum changed"),
    "k": ("1/m", "mass, length or inertia of the pendulum changed"),
    "c": ("1/s", "the friction of the pivot changed"),
}


def _readable(estimate: Estimate) -> str:
    return f"{estimate.value:.4g} [{estimate.low:.4g}, {estimate.high:.4g}]"


def regress(
    time: Array, phi: Array, x: Array, *, tied: bool = True, g: float = GRAVITY
) -> ClosedLoopFit:
    """Regress the pendulum's equation on a log with a moving pivot.

    A log that follows the equation only with x negated is rejected: its phi and x are counted in
    opposite directions.

    The intervals of w2 and k come from a jackknife over blocks of time, and extend to the
    regression with exchanged roles: noise on the regressors biases one regression low and the other
    high (Frisch). Both agree on a log with enough motion.

    Args:
        time: Time stamps [s], increasing, shape (n,).
        phi: Measured angle from upright [rad], shape (n,).
        x: Measured, not commanded, displacement of the pivot [m], shape (n,).
        tied: Constrain k = w2 / g. Otherwise the log needs motion that separates them, such as a
            swing-up.
        g: Acceleration of gravity [m/s^2].

    Returns:
        The parameters, with 95 % intervals.

    Raises:
        RecordingError: The log is too short, its samples cannot be used, it does not follow the
            equation, or phi and x are counted in opposite directions.
    """
    _check(time, phi, x)
    try:
        fit = _regress(time, phi, x, tied, g)
    except RecordingError:
        _reject_mirrored(time, phi, x, tied, g, 1.0)
        raise
    if fit.unexplained > ROUGH_FIT:
        _reject_mirrored(time, phi, x, tied, g, fit.unexplained)
    return fit


def _reject_mirrored(
    time: Array, phi: Array, x: Array, tied: bool, g: float, unexplained: float
) -> None:
    """Reject a log that follows the equation clearly better with x negated."""
    try:
        mirrored = _regress(time, phi, -x, tied, g).unexplained
    except RecordingError:
        return
    if mirrored < MIRRORED_RATIO * unexplained:
        raise RecordingError(
            "phi and x are counted in opposite directions: the equation holds with x negated "
            f"({mirrored:.0%} of the acceleration unexplained) and not as they are; correct the "
            "sign of x, or that of the encoder (encoder_sign in rig.toml)"
        ) from None


def _regress(time: Array, phi: Array, x: Array, tied: bool, g: float) -> ClosedLoopFit:
    """Regress the equation with the signs as given; see `regress`."""
    from scipy.interpolate import CubicSpline
    from scipy.stats import t as student

    phi, length = np.unwrap(phi), float(np.ptp(time))
    blocks = max(round(length / BLOCK_DURATION), MIN_BLOCKS)

    def coupling(solution: _Solution) -> float:
        return float(solution.values[0]) / g if tied else float(solution.values[1])

    def solved(x: Array) -> _Solution:
        rows = _rows(time, phi, x, g, tied)
        if not len(rows.time) or np.ptp(rows.time) < MIN_BLOCKS * WINDOW:
            raise RecordingError(
                f"the log holds {length:.2f} s, expected at least "
                f"{(MIN_BLOCKS + 2) * WINDOW:.1f} s without gaps; balance for longer"
            )
        solution = _solve(rows, blocks)
        w2, left = float(solution.values[0]), solution.unexplained
        if min(w2, coupling(solution)) <= 0.0 or left > MAX_UNEXPLAINED:
            raise RecordingError(
                f"the pendulum's equation leaves {left:.0%} of the acceleration unexplained "
                f"(w2 = {w2:.3g} 1/s^2), expected less than {MAX_UNEXPLAINED:.0%}: the pendulum "
                "stands too still for its encoder, or phi and x do not belong together; look at "
                "their units, signs and clocks, and that phi is 0 upright"
            )
        return solution

    # The latency is linearised, so x is shifted by the first estimate and solved again.
    solution = solved(x)
    late = float(solution.values[LATE]) / coupling(solution)
    solution = solved(CubicSpline(time, x)(np.clip(time + late, time[0], time[-1])))
    w2, k = float(solution.values[0]), coupling(solution)
    quantile = float(student.ppf(0.975, blocks - 1))

    def estimate(weights: dict[int, float], offset: float = 0.0, reach: float = 0.0) -> Estimate:
        """Return a weighted sum of the coefficients with its interval."""
        w = np.zeros(len(solution.values))
        w[list(weights)] = list(weights.values())
        value = offset + float(w @ solution.values)
        half = quantile * sqrt(float(w @ solution.spread @ w))
        low, high = value - half, value + half + reach
        return Estimate(value=value, low=low, high=high, source="identified")

    of_w2, of_k = solution.reach[:2].tolist()
    fit = ClosedLoopFit(
        w2=estimate({0: 1.0}, reach=of_w2),
        k=estimate({0: 1.0 / g}, reach=of_w2 / g) if tied else estimate({1: 1.0}, reach=of_k),
        c=estimate({VISCOUS: 1.0}),
        coulomb=estimate({DRY: 1.0}),
        friction=estimate({VISCOUS: 1.0, DRY: 1.0 / solution.rate}),
        zero=estimate({ZERO: 1.0 / w2}),
        late=estimate({LATE: 1.0 / k}, offset=late),
        rate=solution.rate,
        tied=tied,
        g=g,
        duration=length,
        samples=len(time),
        blocks=blocks,
        unexplained=solution.unexplained,
    )
    return fit.model_copy(update={"warnings": _warnings(fit, phi)})


def compare(
    known: Pendulum, fit: ClosedLoopFit, plant: PlantSettings | None = None
) -> tuple[ParameterChange, ...]:
    """Return the parameters that changed since a pendulum was identified.

    A parameter has changed if the difference exceeds both 95 % intervals, corrected for the number
    of compared parameters (fewer than one false alarm in twenty logs), and exceeds the variation in
    training. Friction is compared at the rates of the log. After a fit with viscous friction alone,
    c contains a part of the dry friction that decreases with the rate: every value between no dry
    friction and that of the log agrees.

    Args:
        known: The identified pendulum.
        fit: Fit of a log.
        plant: Variation of inertia and friction in training.

    Returns:
        The changes; empty if the log agrees.
    """
    from scipy.stats import norm

    plant = plant or PlantSettings()
    pairs: list[tuple[Literal["w2", "k", "c"], Estimate, Estimate, float]]
    pairs = [("w2", known.w2, fit.w2, plant.inertia_sigma)]
    if not fit.tied:
        pairs.append(("k", known.k, fit.k, plant.inertia_sigma))
    if fit.unexplained < ROUGH_FIT:
        pairs.append(("c", *_frictions(known, fit), plant.friction_sigma))
    limit = float(norm.isf(0.025 / len(pairs)))
    moves = [
        ParameterChange(name=name, before=before, now=now, z=_z(before, now))
        for name, before, now, varied in pairs
        if abs(now.value - before.value) > varied * abs(before.value)
    ]
    return tuple(move for move in moves if move.z > limit)


def _frictions(known: Pendulum, fit: ClosedLoopFit) -> tuple[Estimate, Estimate]:
    """Return comparable values of the identified friction and that of the log."""
    if known.friction_model == "viscous":
        low, high = sorted((fit.c, fit.friction), key=lambda estimate: estimate.value)
        within = low.value <= known.c.value <= high.value
        return known.c, known.c if within else min(
            (low, high), key=lambda estimate: abs(estimate.value - known.c.value)
        )
    # In the order of the covariance: Coulomb friction decreases with the rate, drag increases.
    weights = np.array([0.0, 1.0, 1.0 / fit.rate, fit.rate])
    value = float(weights[1:] @ [known.c.value, known.coulomb.value, known.drag.value])
    sigma = sqrt(max(float(weights @ np.array(known.covariance) @ weights), 0.0))
    return Estimate.normal(value, sigma, "identified"), fit.friction


def _z(before: Estimate, now: Estimate) -> float:
    """Return the difference in standard deviations, from the facing halves of the intervals."""
    low, high = sorted((before, now), key=lambda estimate: estimate.value)
    halves = low.high - low.value, high.value - high.low
    return 1.96 * (high.value - low.value) / float(np.hypot(*halves))


class _Rows(NamedTuple):
    """Equation at each time, or averaged over a window around it."""

    time: Array
    """Shape (n,)."""
    terms: Array
    """Regressors of the coefficients, shape (n, p)."""
    acceleration: Array
    """phi_ddot [rad/s^2], shape (n,)."""
    gap: Array
    """Zero outside the neighbourhood of gaps, shape (n,)."""
    rate: Array
    """Smoothed phi_dot [rad/s], shape (n,)."""


class _Solution(NamedTuple):
    """Least-squares solution of the equation."""

    values: Array
    """Coefficients, shape (p,)."""
    spread: Array
    """Covariance of the coefficients, shape (p, p)."""
    reach: Array
    """Increase of each coefficient with exchanged roles, shape (p,)."""
    unexplained: float
    """Root mean square residual over the root mean square acceleration."""
    rate: float
    """Mean square of phi_dot over its mean absolute value [rad/s]."""


# The last four coefficients; before them w2, or w2 and k.
VISCOUS, DRY, ZERO, LATE = range(-4, 0)


def _check(time: Array, phi: Array, x: Array) -> None:
    for name, values in (("time", time), ("phi", phi), ("x", x)):
        if values.shape != (len(time),) or not np.all(np.isfinite(values)):
            raise RecordingError(
                f"{name} has shape {values.shape}, expected {len(time)} finite numbers, one per "
                "time stamp; leave broken samples out"
            )
    if len(time) < 16 or np.any(np.diff(time) <= 0.0):
        raise RecordingError(
            f"the log has {len(time)} samples, expected at least 16 whose time increases; "
            "sort it and leave repeated samples out"
        )


def _rows(time: Array, phi: Array, x: Array, g: float, tied: bool) -> _Rows:
    """Return the equation averaged over a moving window, without gaps; empty for a short log."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import oaconvolve

    usual = float(np.median(np.diff(time)))
    step = usual / POINTS_PER_SAMPLE
    fine = np.arange(time[0], time[-1], step)
    angle, pivot = CubicSpline(time, phi), CubicSpline(time, x)
    sine, cosine = np.sin(angle(fine)), np.cos(angle(fine))
    phi_dot, x_ddot = angle(fine, 1), pivot(fine, 2)
    rate = oaconvolve(phi_dot, _bump(RATE_WINDOW, step), "same")
    push = x_ddot * cosine
    terms = [sine - push / g] if tied else [sine, -push]
    # To first order, a zero error rotates gravity and the pivot's acceleration relative to phi, and
    # a latency tau of x subtracts tau x_dddot.
    turned = cosine + x_ddot * sine / g
    terms += [-phi_dot, -np.sign(rate), -turned, -pivot(fine, 3) * cosine]
    steps = np.diff(time)[np.searchsorted(time, fine, side="right") - 1]
    gap = np.asarray(steps > GAP_RATIO * usual, dtype=np.float64)
    rows = _Rows(fine, np.stack(terms, axis=1), angle(fine, 2), gap, rate)
    bump = _bump(WINDOW, float(fine[1] - fine[0]))
    if len(bump) > len(fine):
        return _Rows(*(column[:0] for column in rows))
    shape = {1: (-1,), 2: (-1, 1)}
    means = (oaconvolve(each, bump.reshape(shape[each.ndim]), "valid", axes=0) for each in rows)
    rows = _Rows(*(mean[::POINTS_PER_SAMPLE] for mean in means))
    # Convolution by FFT leaves 1e-17 outside gaps.
    return _Rows(*(column[rows.gap < 1e-6] for column in rows))


def _bump(length: float, step: float) -> Array:
    """Return a smooth window (1 - s^2)^3 of length `length` [s] and sum one."""
    n = max(round(length / step), 4)
    bump = (1.0 - np.linspace(-1.0, 1.0, n + 1)[1:-1] ** 2) ** 3
    return bump / np.sum(bump)


def _solve(rows: _Rows, blocks: int) -> _Solution:
    M, y = rows.terms, rows.acceleration
    values = np.linalg.lstsq(M, y, rcond=None)[0].astype(np.float64)
    residual = y - M @ values
    # Increase of the slope in a regression of term j on all others.
    inverse = np.diag(np.linalg.pinv(M.T @ M, hermitian=True))
    reach = float(residual @ residual) * inverse / np.where(values == 0.0, np.inf, values)
    return _Solution(
        values=values,
        spread=jackknife(M, residual, blocks_of_time(rows.time, blocks)),
        reach=reach,
        unexplained=float(np.linalg.norm(residual) / max(float(np.linalg.norm(y)), 1e-12)),
        rate=float(np.mean(rows.rate**2) / max(float(np.mean(np.abs(rows.rate))), 1e-12)),
    )


def _warnings(fit: ClosedLoopFit, phi: Array) -> tuple[str, ...]:
    warnings: list[str] = []
    if fit.unexplained > ROUGH_FIT:
        warnings.append(
            f"the equation leaves {fit.unexplained:.0%} of the acceleration unexplained, expected "
            f"less than {ROUGH_FIT:.0%}: friction is hidden in noise, and w2 is rough; phi moves "
            f"by {np.rad2deg(np.std(phi)):.2g} deg RMS, let it move more or use a finer encoder"
        )
    if max(fit.late.low, -fit.late.high) > MAX_LATENESS:
        warnings.append(
            f"x comes {1e3 * abs(fit.late.value):.1f} ms "
            f"{'later' if fit.late.value > 0.0 else 'earlier'} than the phi of its time stamp; "
            "the fit allows for it, but look at the clocks"
        )
    return tuple(warnings)
