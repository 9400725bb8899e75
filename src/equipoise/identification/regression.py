r"""Regression of the pendulum's equation on a log of balancing, with a moving pivot.

.. math:: \ddot\varphi = w_2 (\sin\varphi - \ddot x \cos\varphi / g) - c\,\dot\varphi
          - f\,\mathrm{sign}\,\dot\varphi

phi from upright and x, the *measured* pivot, positive the same way (Safeea & Neto, section 3.2). A
rigid pendulum has k = w2 / g: while a policy balances, phi and x_ddot are correlated, and separate
estimates of w2 and k would be poor. The equation is linear in its parameters. Two additional terms
model errors of the log: the zero error of the encoder and the latency of x. The equation does not
hold for a flange that tilts or rises: add the tilt to phi; vertical motion is not modelled.

The log holds no accelerations. Direct differentiation amplifies the encoder's steps beyond the
motion of a balanced pendulum. Smoothing first removes different parts of the motion from phi and x
than from sin phi, and biases w2 by some percent. The weak form avoids both: the equation is
multiplied by a smooth window and integrated. Cubic splines through the samples give every term; by
integration by parts, their second derivatives under the window equal the samples under its second
derivative. All terms see the same window.
"""

from typing import Final

import numpy as np

from equipoise.arrays import Array
from equipoise.artefacts import Estimate, Value
from equipoise.errors import RecordingError
from equipoise.identification.least_squares import half_width, jackknife
from equipoise.settings import GRAVITY

WINDOW: Final = 0.3
"""Length of the smooth window [s]. Shorter windows pass the encoder's steps; longer windows lose
the fast part of the motion, and dry friction with it."""
MIN_BLOCKS: Final = 8
"""Minimum number of blocks; the scatter of fewer blocks is meaningless."""
MAX_UNEXPLAINED: Final = 0.7
"""Largest accepted unexplained fraction of the acceleration; more indicates another motion. A
pendulum that moves by two counts of its encoder leaves 0.5."""
ROUGH_FIT: Final = 0.1
"""Unexplained fraction above which friction is indistinguishable from noise. Balancing with a table
leaves 0.01."""

W2, C, COULOMB, ZERO, LATE = range(5)
"""Indices of the coefficients: w2, the frictions, w2 times the zero error, k times the latency."""


class ClosedLoopFit(Value):
    """Pendulum parameters from a closed-loop log, with 95 % intervals."""

    w2: Estimate
    """Gravity over inertia, m g l / I [1/s^2]."""
    k: Estimate
    """Coupling to the pivot's acceleration, w2 / g [1/m]."""
    c: Estimate
    """Viscous friction over inertia [1/s]."""
    coulomb: Estimate
    """Coulomb friction over inertia [1/s^2]."""
    zero: Estimate
    """Zero error of the encoder: phi as read minus true [rad]."""
    late: Estimate
    """Latency of x relative to phi [s]."""
    duration: float
    """Length of the log [s]."""
    samples: int
    """Number of samples of the log."""
    unexplained: float
    """Root mean square residual over the root mean square acceleration."""
    warnings: tuple[str, ...] = ()
    """Warnings about a poor log, with remedies."""


def regress(time: Array, phi: Array, x: Array, *, g: float = GRAVITY) -> ClosedLoopFit:
    """Regress the pendulum's equation on a log with a moving pivot.

    The intervals come from a jackknife over blocks of time. That of w2 extends to the regression
    with exchanged roles: noise on the regressors biases one regression low and the other high
    (Frisch). Both agree on a log with enough motion.

    Args:
        time: Time stamps [s], increasing, shape (n,).
        phi: Measured angle from upright [rad], shape (n,).
        x: Measured, not commanded, displacement of the pivot [m], shape (n,).
        g: Acceleration of gravity [m/s^2].

    Returns:
        The parameters, with 95 % intervals.

    Raises:
        RecordingError: The log is too short, its samples cannot be used, or it does not follow the
            equation.
    """
    from scipy.interpolate import CubicSpline

    finite = all(len(values) == len(time) and np.all(np.isfinite(values)) for values in (phi, x))
    if not finite or len(time) < 16 or not np.all(np.diff(time) > 0.0):
        raise RecordingError(
            f"the log has {len(time)} samples, expected at least 16 finite ones whose time "
            "increases; sort it and leave broken and repeated samples out"
        )
    phi, length = np.unwrap(phi), float(np.ptp(time))
    # A block of 2 s is longer than the correlation of the motion.
    blocks = max(round(length / 2.0), MIN_BLOCKS)
    # The latency is linearised, so x is shifted by the first estimate and solved again.
    values, *_ = _solve(*_averaged(time, phi, x, g)[1:])
    late = float(values[LATE] / values[W2]) * g
    moved = CubicSpline(time, x)(np.clip(time + late, time[0], time[-1]))
    when, M, y = _averaged(time, phi, moved, g)
    values, residual, unexplained = _solve(M, y)
    w2 = float(values[W2])
    spread = jackknife(M, residual, when, blocks)
    # Increase of the slope in a regression of gravity's term on all others.
    inverse = float(np.linalg.pinv(M.T @ M, hermitian=True)[0, 0])
    reach = float(residual @ residual) * inverse / w2

    def estimate(
        place: int, factor: float = 1.0, offset: float = 0.0, reach: float = 0.0
    ) -> Estimate:
        """Return a coefficient times a factor, with its interval."""
        value = offset + factor * float(values[place])
        half = half_width(factor**2 * float(spread[place, place]), blocks)
        low, high = value - half, value + half + reach
        return Estimate(value=value, low=low, high=high, source="identified")

    late_x = estimate(LATE, g / w2, offset=late)
    warnings: list[str] = []
    if unexplained > ROUGH_FIT:
        warnings.append(
            f"the equation leaves {unexplained:.0%} of the acceleration unexplained, expected "
            f"less than {ROUGH_FIT:.0%}: friction is hidden in noise, and w2 is rough; let the "
            "pendulum move more, use a finer encoder, or look at encoder_sign in rig.toml"
        )
    if max(late_x.low, -late_x.high) > 0.002:  # [s]
        warnings.append(
            f"x comes {1e3 * late_x.value:.1f} ms later than the phi of its time stamp (negative:"
            " earlier); the fit allows for it, but look at the clocks"
        )
    return ClosedLoopFit(
        w2=estimate(W2, reach=reach),
        k=estimate(W2, 1.0 / g, reach=reach / g),
        c=estimate(C),
        coulomb=estimate(COULOMB),
        zero=estimate(ZERO, 1.0 / w2),
        late=late_x,
        duration=length,
        samples=len(time),
        unexplained=unexplained,
        warnings=tuple(warnings),
    )


def _averaged(time: Array, phi: Array, x: Array, g: float) -> tuple[Array, Array, Array]:
    """Return the equation averaged over a moving window, without gaps.

    Returns:
        Times [s], shape (n,), the regressors of the coefficients, shape (n, 5), and phi_ddot,
        shape (n,).

    Raises:
        RecordingError: The log is too short.
    """
    from scipy.interpolate import CubicSpline
    from scipy.signal import oaconvolve

    usual = float(np.median(np.diff(time)))
    # Four points per sample integrate a window to rounding error.
    step = usual / 4
    fine = np.arange(time[0], time[-1], step)
    angle, pivot = CubicSpline(time, phi), CubicSpline(time, x)
    sine, cosine = np.sin(angle(fine)), np.cos(angle(fine))
    phi_dot, x_ddot = angle(fine, 1), pivot(fine, 2)
    # Longer windows miss short swings, and half of the dry friction with them; shorter windows pass
    # the encoder's steps.
    rate = oaconvolve(phi_dot, _bump(0.06, step), "same")
    # To first order, a zero error rotates gravity and the pivot's acceleration relative to phi, and
    # a latency tau of x subtracts tau x_dddot.
    terms = [sine - x_ddot * cosine / g, -phi_dot, -np.sign(rate)]
    terms += [-cosine - x_ddot * sine / g, -pivot(fine, 3) * cosine]
    steps = np.diff(time)[np.searchsorted(time, fine, side="right") - 1]
    gap = np.asarray(steps > 3.5 * usual, dtype=np.float64)
    columns = np.stack([fine - time[0], *terms, angle(fine, 2), gap], axis=1)
    bump = _bump(WINDOW, step)[:, None]
    if len(bump) <= len(fine):
        means = np.asarray(oaconvolve(columns, bump, "valid", axes=0))[::4]
        rows = means[means[:, -1] < 1e-6]  # convolution by FFT leaves 1e-17 outside gaps
        if len(rows) and np.ptp(rows[:, 0]) >= MIN_BLOCKS * WINDOW:
            return rows[:, 0], rows[:, 1:6], rows[:, 6]
    raise RecordingError(
        f"the log holds {np.ptp(time):.2f} s, expected at least {(MIN_BLOCKS + 2) * WINDOW:.1f} s "
        "without gaps; balance for longer"
    )


def _bump(length: float, step: float) -> Array:
    """Return a smooth window (1 - s^2)^3 of length `length` [s] and sum one."""
    n = max(round(length / step), 4)
    bump = (1.0 - np.linspace(-1.0, 1.0, n + 1)[1:-1] ** 2) ** 3
    return bump / np.sum(bump)


def _solve(M: Array, y: Array) -> tuple[Array, Array, float]:
    """Return the coefficients, shape (5,), the residual, shape (n,), and its fraction of y.

    Raises:
        RecordingError: The log does not follow the equation.
    """
    values = np.linalg.lstsq(M, y, rcond=None)[0].astype(np.float64)
    residual = y - M @ values
    w2, left = float(values[W2]), float(np.linalg.norm(residual) / max(np.linalg.norm(y), 1e-12))
    if w2 <= 0.0 or left > MAX_UNEXPLAINED:
        raise RecordingError(
            f"the pendulum's equation leaves {left:.0%} of the acceleration unexplained "
            f"(w2 = {w2:.3g} 1/s^2), expected less than {MAX_UNEXPLAINED:.0%}: the pendulum "
            "stands too still for its encoder, or phi and x do not belong together; look at "
            "their units, signs (encoder_sign in rig.toml) and clocks, and that phi is 0 upright"
        )
    return values, residual, left
