r"""Bound on the releases of the pendulum that any controller can balance.

Near upright the pendulum of `equipoise.model.pendulum` has the roots :math:`\lambda` and
:math:`-\mu` of :math:`s^2 + c s - w_2`. With friction f the diverging angle obeys

.. math:: \zeta = \varphi + \dot\varphi / \mu, \qquad
    \dot\zeta = \lambda \zeta - (k u + f\,\mathrm{sign}\,\dot\varphi) / \mu

No acceleration up to :math:`u_{max}` turns it back beyond :math:`(k u_{max} + f) / w_2`, about
:math:`u_{max} / g` for every pendulum. During the delay T of the arm it grows by
:math:`e^{\lambda T}`. Track and failure angle leave less; `experiments/recoverable.py` encloses
that set.
"""

from math import degrees, log1p, sqrt
from typing import Any, Final

import numpy as np

from equipoise import paper
from equipoise.arrays import Array
from equipoise.errors import SettingsError
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import Settings

CLOSE: Final = 0.75
"""Diverging angle of the worst release, as a fraction of its limit, above which a warning is given:
along a release the shipped table holds starts up to 0.58 of the limit, LQR up to 0.86."""
RELEASES: Final = 1000
"""Number of releases for the fraction that is recoverable."""


def fall_rate(pendulum: PendulumParameters) -> float:
    """Return the rate at which the pendulum falls, the root lambda [1/s]."""
    return 0.5 * (sqrt(pendulum.c**2 + 4.0 * pendulum.w2) - pendulum.c)


def diverging_angle(phi: Any, phi_dot: Any, pendulum: PendulumParameters) -> Any:
    """Return the diverging angle phi + phi_dot / mu [rad].

    Args:
        phi: Angle from upright [rad], a number or an array.
        phi_dot: Angular velocity [rad/s].
        pendulum: The pendulum.
    """
    return phi + phi_dot / (fall_rate(pendulum) + pendulum.c)


def recoverable_angle(pendulum: PendulumParameters, u_max: float = paper.U_MAX) -> float:
    """Return the diverging angle beyond which no command turns the pendulum back [rad].

    Args:
        pendulum: The pendulum.
        u_max: Largest acceleration of the flange [m/s^2].
    """
    return (pendulum.k * u_max + pendulum.coulomb) / pendulum.w2


def diverging_angles(pendulum: PendulumParameters, settings: Settings, actuator: Actuator) -> Array:
    r"""Return the diverging angles of releases when the arm responds [rad], shape (RELEASES,).

    Angles, rates, transport delay and lag vary as in trials. A lag delays the effect on the fall
    by :math:`\ln(1 + \lambda \tau) / \lambda`; the servo's own delay is left out.

    Args:
        pendulum: The pendulum.
        settings: Releases (`evaluation`) and variation of the plant (`plant`).
        actuator: Model of the arm's response.
    """
    e, plant, rate = settings.evaluation, settings.plant, fall_rate(pendulum)
    draws = np.random.default_rng(0).random((RELEASES, 4))
    phi = e.phi_low + (e.phi_high - e.phi_low) * draws[:, 0]
    phi_dot = e.phi_dot_low + (e.phi_dot_high - e.phi_dot_low) * draws[:, 1]
    growth = np.zeros(RELEASES)
    if actuator.kind != "ideal":
        lag = float(np.mean([one.value for one in actuator.lags]))
        growth += rate * (actuator.delay.value + plant.delay_spread * (2.0 * draws[:, 2] - 1.0))
        growth += log1p(rate * lag) + rate * lag * plant.lag_spread * (2.0 * draws[:, 3] - 1.0)
    resisted = pendulum.coulomb / pendulum.w2
    start = np.maximum(diverging_angle(phi, phi_dot, pendulum) - resisted, 0.0)
    # Beyond e^50 a pendulum has fallen long ago.
    return start * np.exp(np.clip(growth, 0.0, 50.0)) + resisted


def check_releases(
    pendulum: PendulumParameters, settings: Settings, actuator: Actuator, least: float = 0.0
) -> str | None:
    """Reject a task whose releases no controller recovers.

    Args:
        pendulum: The pendulum.
        settings: Releases (`evaluation`) and variation of the plant (`plant`).
        actuator: Model of the arm's response.
        least: Required fraction of the releases that may be recoverable.

    Returns:
        A warning if a part of the releases is lost, or the worst is close to the limit, else None.

    Raises:
        SettingsError: All releases are lost, or more than allowed.
    """
    angles = diverging_angles(pendulum, settings, actuator)
    limit = recoverable_angle(pendulum)
    worst, fraction = float(np.max(angles)), float(np.mean(angles <= limit))
    if worst <= CLOSE * limit:
        return None
    text = (
        f"no controller saves {1.0 - fraction:.1%} of the releases: the worst one "
        f"leans {degrees(worst):.1f} deg when the arm responds, and at most "
        f"{degrees(limit):.1f} deg can be turned back; shorten the delay, release "
        "gently (evaluation.phi_high, evaluation.phi_dot_high), or take another pendulum"
    )
    if fraction == 0.0 or fraction < least:
        raise SettingsError(text)
    return text
