r"""A log of balancing becomes a pendulum: regression on an equation whose pivot moves.

.. math:: \ddot\varphi = w_2 \sin\varphi - k\,\ddot x \cos\varphi - c\,\dot\varphi
          - f\,\mathrm{sign}\,\dot\varphi

phi from upright and x, the *measured* pivot, positive the same way (Safeea & Neto, section 3.2).
The equation is linear in what is looked for. Two terms more take up what a log brings along: the
encoder's zero error, and a time by which x comes late. Where the flange tilts or rises the equation
does not hold: the tilt is to be added to phi, and vertical motion is not modelled.

Nobody records accelerations. Differentiated, the steps of an encoder become larger than the motion
of a pendulum that stands; smoothed before, phi and x lose other parts of the motion than sin phi
does, and w2 and k are wrong by some percent. So the equation is multiplied by a smooth window and
integrated: cubic splines through the samples give every term, and integration by parts says that
their second derivatives under a smooth window are the samples themselves under its second
derivative (the weak form). All terms see the same window, whatever it smooths.

While a policy balances, phi and x_ddot go together, and a fit of w2 and k apart is poor. For a
rigid pendulum k = w2 / g; tied so, a log of a minute gives the inertia to a thousandth.
"""

from contextlib import suppress
from math import sqrt
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import Estimate, Value
from equipoise.errors import RecordingError
from equipoise.identification.jackknife import blocks_of_time, jackknife
from equipoise.model.pendulum import Pendulum
from equipoise.settings import GRAVITY, PlantSettings

Array = npt.NDArray[np.float64]

WINDOW: Final = 0.3
"""Length of the smooth window [s]. Shorter ones see the encoder's steps; longer ones lose the fast
part of the motion, and dry friction with it."""
RATE_WINDOW: Final = 0.06
"""Length of the window over which the direction of the motion is told [s]: longer ones miss short
swings, and half of the dry friction with them; shorter ones see the encoder's steps."""
FINENESS: Final = 4
"""Points of the splines per sample: enough for a window to be integrated as if exactly."""
BLOCK: Final = 2.0
"""Length of the blocks of the jackknife [s]: the motion has forgotten itself between two."""
LEAST_BLOCKS: Final = 8
"""... but so many blocks at least: with fewer their spread says nothing."""
GAP: Final = 3.5
"""Samples that are so many usual steps apart have a gap between them, which is left out."""
REFUSED: Final = 0.7
"""A log is refused where more than this share of the acceleration stays unexplained: it belongs to
another motion. A pendulum that moves by two counts of its encoder leaves 0.5."""
TOO_LATE: Final = 0.002
"""A warning is given where x comes later or earlier than phi by more than this [s]."""
ROUGH: Final = 0.1
"""Where more than this share stays unexplained, friction is not told from noise. Balancing with a
table leaves 0.01."""

MIRRORED: Final = 0.5
"""Phi and x are in opposite directions where negating x leaves less than this share unexplained of
what the equation leaves as they are."""

Derivatives = Literal["weak", "savitzky-golay"]
"""How a motion is differentiated: under a smooth window; or sample by sample by the polynomials of
Savitzky & Golay (11 samples, cubic), as published regressions do, bias and all."""


class ClosedLoopFit(Value):
    """What a closed-loop log says about its pendulum, with 95 % intervals."""

    w2: Estimate
    """Gravity over inertia, m g l / I [1/s^2]."""
    k: Estimate
    """Coupling to the pivot's acceleration, m l / I [1/m]."""
    c: Estimate
    """Viscous friction over inertia [1/s]."""
    coulomb: Estimate
    """Coulomb friction over inertia [1/s^2]."""
    friction: Estimate
    """The viscous friction that would take out as much energy as both, c + coulomb / rate [1/s]:
    it is known better than either."""
    zero: Estimate
    """Zero error of the encoder: phi as read minus true [rad]."""
    late: Estimate
    """How much later than phi its x was taken [s]."""
    rate: float
    """Mean square of phi_dot over its mean size [rad/s]."""
    tied: bool
    """k was tied to w2: k = w2 / g."""
    g: float
    """Acceleration of gravity [m/s^2]."""
    derivatives: Derivatives
    """How the motion was differentiated."""
    duration: float
    """Length of the log [s]."""
    samples: int
    """Samples of the log."""
    blocks: int
    """Blocks of the jackknife."""
    unexplained: float
    """Root mean square of what the equation leaves, over that of the acceleration."""
    warnings: tuple[str, ...] = ()
    """Where the log says little, and what to do."""


class ParameterChange(Value):
    """A parameter that a log finds elsewhere than it was."""

    name: Literal["w2", "k", "c"]
    """Name of the parameter."""
    before: Estimate
    """What was known."""
    now: Estimate
    """What the log says."""
    z: float
    """Difference in standard deviations of both."""

    @property
    def text(self) -> str:
        """One line for a person."""
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
    time: Array,
    phi: Array,
    x: Array,
    *,
    tied: bool = True,
    derivatives: Derivatives = "weak",
    window: float = WINDOW,
    g: float = GRAVITY,
) -> ClosedLoopFit:
    """Regress the pendulum's equation on a log in which its pivot moves.

    A log whose phi and x are counted in opposite directions is refused by name: with one of them
    negated it follows the equation.

    The intervals of w2 and k come from a jackknife over blocks of time, and reach on to the
    regression with the roles exchanged: noise on the regressors makes the one too small and the
    other too large (Frisch). On a log with enough motion the two are the same.

    Args:
        time: Time stamps [s], increasing, shape (n,).
        phi: Angle from upright [rad], shape (n,): as read from the encoder.
        x: Displacement of the pivot [m], shape (n,): as measured, not as commanded.
        tied: Take k = w2 / g; free, the log must hold motion that tells them apart, such as a
            swing-up.
        derivatives: How to differentiate.
        window: Length of the smooth window of the weak form [s].
        g: Acceleration of gravity [m/s^2].

    Returns:
        The parameters, with 95 % intervals.

    Raises:
        RecordingError: The log is too short, its samples cannot be used, it does not follow the
            equation, or phi and x are counted in opposite directions.
    """
    _check(time, phi, x)
    how: dict[str, Any] = {"tied": tied, "derivatives": derivatives, "window": window, "g": g}
    fit, refusal = None, None
    try:
        fit = _regress(time, phi, x, **how)
    except RecordingError as error:
        refusal = error
    if fit is None or fit.unexplained > ROUGH:
        left = 1.0 if fit is None else fit.unexplained
        with suppress(RecordingError):
            mirrored = _regress(time, phi, -x, **how)
            if mirrored.unexplained < MIRRORED * left:
                refusal = RecordingError(
                    "phi and x are counted in opposite directions: the equation holds with x "
                    f"negated ({mirrored.unexplained:.0%} of the acceleration unexplained) and not "
                    "as they are; correct the sign of x, or that of the encoder (encoder_sign in "
                    "rig.toml)"
                )
    if fit is None or refusal is not None:
        raise refusal or RecordingError("the log does not follow the equation")
    return fit


def _regress(
    time: Array,
    phi: Array,
    x: Array,
    *,
    tied: bool,
    derivatives: Derivatives,
    window: float,
    g: float,
) -> ClosedLoopFit:
    """Regress the equation with the signs as they are; see `regress`."""
    from scipy.interpolate import CubicSpline
    from scipy.stats import t as student

    phi, length = np.unwrap(phi), float(np.ptp(time))
    blocks = max(round(length / BLOCK), LEAST_BLOCKS)

    def solved(x: Array) -> _Solution:
        if derivatives == "weak":
            rows = _averaged(_rows(_by_splines(time, phi, x), g, tied), window)
        else:
            rows = _rows(_by_polynomials(time, phi, x), g, tied)
        rows = rows.without_gaps()
        if not len(rows.time) or np.ptp(rows.time) < LEAST_BLOCKS * window:
            raise RecordingError(
                f"the log holds {length:.2f} s, expected at least "
                f"{(LEAST_BLOCKS + 2) * window:.1f} s without gaps; balance for longer"
            )
        solution = _solve(rows, blocks)
        _refuse(float(solution.values[0]), coupling(solution), solution.unexplained)
        return solution

    def coupling(solution: _Solution) -> float:
        return float(solution.values[0]) / g if tied else float(solution.values[1])

    # What comes late is found to first order, and again after moving x by it.
    solution = solved(x)
    late = float(solution.values[LATE]) / coupling(solution)
    solution = solved(CubicSpline(time, x)(np.clip(time + late, time[0], time[-1])))
    w2, k = float(solution.values[0]), coupling(solution)
    quantile = float(student.ppf(0.975, blocks - 1))

    def estimate(weights: dict[int, float], offset: float = 0.0, reach: float = 0.0) -> Estimate:
        """Return a weighted sum of the coefficients."""
        w = np.zeros(len(solution.values))
        w[list(weights)] = list(weights.values())
        value = offset + float(w @ solution.values)
        half = quantile * sqrt(float(w @ solution.spread @ w))
        return Estimate(
            value=value, low=value - half, high=value + half + reach, source="identified"
        )

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
        derivatives=derivatives,
        duration=length,
        samples=len(time),
        blocks=blocks,
        unexplained=solution.unexplained,
    )
    return fit.model_copy(update={"warnings": _warnings(fit, phi)})


def compare(
    known: Pendulum, fit: ClosedLoopFit, plant: PlantSettings | None = None
) -> tuple[ParameterChange, ...]:
    """Return which parameters moved since a pendulum was identified.

    A parameter moved where the difference is beyond both 95 % intervals, corrected for the number
    of parameters that are looked at (with nothing moved, fewer than one log in twenty is blamed),
    and beyond what training varies anyway. Friction is compared at the rates of the log. In a free
    swing that was fitted with viscous friction alone, c holds a part of the dry friction, which
    falls with the rate: anything between none and that of the log agrees.

    Args:
        known: The pendulum as it was identified.
        fit: What a log says.
        plant: How far training varies inertia and friction.

    Returns:
        What moved; empty where the log agrees.
    """
    from scipy.stats import norm

    plant = plant or PlantSettings()
    pairs: list[tuple[Literal["w2", "k", "c"], Estimate, Estimate, float]]
    pairs = [("w2", known.w2, fit.w2, plant.inertia_sigma)]
    if not fit.tied:
        pairs.append(("k", known.k, fit.k, plant.inertia_sigma))
    if fit.unexplained < ROUGH:
        pairs.append(("c", *_frictions(known, fit), plant.friction_sigma))
    limit = float(norm.isf(0.025 / len(pairs)))
    moves = [
        ParameterChange(name=name, before=before, now=now, z=_z(before, now))
        for name, before, now, varied in pairs
        if abs(now.value - before.value) > varied * abs(before.value)
    ]
    return tuple(move for move in moves if move.z > limit)


def _frictions(known: Pendulum, fit: ClosedLoopFit) -> tuple[Estimate, Estimate]:
    """Return the friction that was known and the one of the log, as they can be compared."""
    if known.friction_model == "viscous":
        low, high = sorted((fit.c, fit.friction), key=lambda estimate: estimate.value)
        within = low.value <= known.c.value <= high.value
        return known.c, known.c if within else min(
            (low, high), key=lambda estimate: abs(estimate.value - known.c.value)
        )
    # Coulomb friction falls with the rate and drag rises; the places are those of the covariance.
    weights = np.array([0.0, 1.0, 1.0 / fit.rate, fit.rate])
    value = float(weights[1:] @ [known.c.value, known.coulomb.value, known.drag.value])
    sigma = sqrt(max(float(weights @ np.array(known.covariance) @ weights), 0.0))
    return Estimate.normal(value, sigma, "identified"), fit.friction


def _z(before: Estimate, now: Estimate) -> float:
    """Return the difference in standard deviations, by the sides that face each other."""
    difference = now.value - before.value
    if difference > 0.0:
        halves = before.high - before.value, now.value - now.low
    else:
        halves = before.value - before.low, now.high - now.value
    return 1.96 * abs(difference) / float(np.hypot(*halves))


class _Motion(NamedTuple):
    """A log, differentiated; each of shape (n,)."""

    time: Array
    phi: Array
    phi_dot: Array
    phi_ddot: Array
    x_ddot: Array
    x_dddot: Array
    rate: Array
    """phi_dot again, smooth enough to tell its sign [rad/s]."""
    gap: Array
    """1 within a gap of the log, else 0."""


class _Rows(NamedTuple):
    """The equation at each time, or under the window around it."""

    time: Array
    """Shape (n,)."""
    terms: Array
    """What the coefficients stand before, shape (n, p)."""
    acceleration: Array
    """phi_ddot [rad/s^2], shape (n,)."""
    gap: Array
    """Zero where no gap is near, shape (n,)."""
    rate: Array
    """A smooth phi_dot [rad/s], shape (n,)."""

    def without_gaps(self) -> "_Rows":
        # Convolution by FFT leaves 1e-17 where there is none.
        keep = self.gap < 1e-6
        return _Rows(*(column[keep] for column in self))


class _Solution(NamedTuple):
    """Least squares on the equation."""

    values: Array
    """Coefficients, shape (p,)."""
    spread: Array
    """Their covariance, shape (p, p)."""
    reach: Array
    """How much larger each is with the roles exchanged, shape (p,)."""
    unexplained: float
    """Root mean square of the residual over that of the acceleration."""
    rate: float
    """Mean square of phi_dot over its mean size [rad/s]."""


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


def _by_splines(time: Array, phi: Array, x: Array) -> _Motion:
    """Differentiate the cubic splines through the samples."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import oaconvolve

    usual = float(np.median(np.diff(time)))
    step = usual / FINENESS
    fine = np.arange(time[0], time[-1], step)
    angle, pivot = CubicSpline(time, phi), CubicSpline(time, x)
    phi_dot = angle(fine, 1)
    steps = np.diff(time)[np.searchsorted(time, fine, side="right") - 1]
    return _Motion(
        time=fine,
        phi=angle(fine),
        phi_dot=phi_dot,
        phi_ddot=angle(fine, 2),
        x_ddot=pivot(fine, 2),
        x_dddot=pivot(fine, 3),
        rate=oaconvolve(phi_dot, _bump(RATE_WINDOW, step), "same"),
        gap=np.asarray(steps > GAP * usual, dtype=np.float64),
    )


def _by_polynomials(time: Array, phi: Array, x: Array) -> _Motion:
    """Differentiate the cubics that fit 11 samples each (Savitzky & Golay)."""
    from scipy.signal import savgol_filter

    step = float(np.median(np.diff(time)))
    uneven = float(np.max(np.abs(np.diff(time) / step - 1.0)))
    if uneven > 0.1:
        raise RecordingError(
            f"the steps of the log differ by up to {uneven:.0%}, expected less than 10 % for "
            "polynomials; use the weak form"
        )

    def derivative(values: Array, order: int) -> Array:
        return np.asarray(savgol_filter(values, 11, 3, deriv=order, delta=step))

    phi_dot = derivative(phi, 1)
    return _Motion(
        time=time,
        phi=phi,
        phi_dot=phi_dot,
        phi_ddot=derivative(phi, 2),
        x_ddot=derivative(x, 2),
        x_dddot=derivative(x, 3),
        rate=phi_dot,
        gap=np.zeros(len(time)),
    )


def _rows(motion: _Motion, g: float, tied: bool) -> _Rows:
    sine, cosine = np.sin(motion.phi), np.cos(motion.phi)
    push = motion.x_ddot * cosine
    terms = [sine - push / g] if tied else [sine, -push]
    # To first order: a zero error turns gravity and the pivot's acceleration, as phi feels them,
    # and an x that is late by tau lacks tau x_dddot.
    turned = cosine + motion.x_ddot * sine / g
    terms += [-motion.phi_dot, -np.sign(motion.rate), -turned, -motion.x_dddot * cosine]
    return _Rows(motion.time, np.stack(terms, axis=1), motion.phi_ddot, motion.gap, motion.rate)


def _bump(length: float, step: float) -> Array:
    """Return a smooth window (1 - s^2)^3 of that length [s] whose sum is one."""
    n = max(round(length / step), 4)
    bump = (1.0 - np.linspace(-1.0, 1.0, n + 1)[1:-1] ** 2) ** 3
    return bump / np.sum(bump)


def _averaged(rows: _Rows, window: float) -> _Rows:
    """Return the equation under a window that moves on by a sample from row to row."""
    from scipy.signal import oaconvolve

    bump = _bump(window, float(rows.time[1] - rows.time[0]))
    if len(bump) > len(rows.time):
        return _Rows(*(column[:0] for column in rows))
    shape = {1: (-1,), 2: (-1, 1)}
    return _Rows(
        *(
            oaconvolve(column, bump.reshape(shape[column.ndim]), "valid", axes=0)[::FINENESS]
            for column in rows
        )
    )


def _solve(rows: _Rows, blocks: int) -> _Solution:
    M, y = rows.terms, rows.acceleration
    values = np.linalg.lstsq(M, y, rcond=None)[0].astype(np.float64)
    residual = y - M @ values
    # A regression of term j on all else is steeper by this.
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
    if fit.unexplained > ROUGH:
        warnings.append(
            f"the equation leaves {fit.unexplained:.0%} of the acceleration unexplained, expected "
            f"less than {ROUGH:.0%}: friction is not told from noise, and w2 is rough; phi moves "
            f"by {np.rad2deg(np.std(phi)):.2g} deg RMS, let it move more or read it finer"
        )
    if max(fit.late.low, -fit.late.high) > TOO_LATE:
        warnings.append(
            f"x comes {1e3 * abs(fit.late.value):.1f} ms "
            f"{'later' if fit.late.value > 0.0 else 'earlier'} than the phi of its time stamp; "
            "the fit allows for it, but look at the clocks"
        )
    return tuple(warnings)


def _refuse(w2: float, k: float, unexplained: float) -> None:
    if w2 <= 0.0 or k <= 0.0 or unexplained > REFUSED:
        raise RecordingError(
            f"the pendulum's equation leaves {unexplained:.0%} of the acceleration unexplained "
            f"(w2 = {w2:.3g} 1/s^2), expected less than {REFUSED:.0%}: the pendulum stands too "
            "still for its encoder, or phi and x do not belong together; look at their units, "
            "signs and clocks, and that phi is 0 upright"
        )
