r"""Linear control of the pendulum at upright: baseline policies, and the gains of the observer.

The baselines (LQR, LQR snapped to the eight actions, PD, random) use the pendulum's nominal
parameters and the same observation as the table.

**The observer** turns encoder counts into phi, phi_dot and the bias of phi. Between two ticks it
moves its estimate by the pendulum's own equation, driven by the acceleration of the pivot; then the
newest count corrects it:

.. math:: \hat s \leftarrow \hat s + L\,(y - \hat\varphi - \hat\beta), \qquad
          \hat s = (\hat\varphi, \hat{\dot\varphi}, \hat\beta)

The bias beta is the encoder's zero offset. A balanced pendulum is upright on average: a persistent
lean would require a mean acceleration of the pivot of g beta. That makes beta observable; it may
drift slowly.

L is the stationary Kalman gain at upright. The observer needs no window of past counts, and uses
each count at its own time (`equipoise.control.control_step` has the formulas).
"""

import math
from typing import Final

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.policy import LINEAR, RANDOM, SNAPPED, PolicyKernel
from equipoise.errors import InputError
from equipoise.model.pendulum import PendulumParameters

Gains = tuple[float, float, float]

ACCELERATION_SIGMA: Final = 1.5
"""Standard deviation of the disturbance of phi_ddot [rad/s^2]: dry friction, and an error of
0.2 m/s^2 in the pivot's acceleration."""
ANGLE_SIGMA: Final = 3e-4
"""Standard deviation of a measured angle beyond the encoder's quantization [rad]: an error of
0.3 ms in a time stamp at 1 rad/s. A sensor with an error of 0.1 rad (6 deg) is useless within
11 deg."""
BIAS_DRIFT: Final = math.radians(0.05)
"""Drift of the bias in one second [rad], which sets the speed of the zero estimation."""


def baselines(pendulum: PendulumParameters, h: float) -> dict[str, PolicyKernel]:
    """Return the baselines by name.

    Args:
        pendulum: Nominal parameters.
        h: Time step [s].
    """
    gains = lqr_gains(pendulum, h)
    return {
        "LQR": PolicyKernel(LINEAR, gains=gains),
        "LQR, snapped": PolicyKernel(SNAPPED, gains=gains),
        "PD": PolicyKernel(LINEAR, gains=pd_gains(pendulum)),
        "random": PolicyKernel(RANDOM),
    }


def state_space(pendulum: PendulumParameters) -> tuple[Array, Array]:
    """Return A and B of the paper's equation (7), the state being (x, x_dot, phi, phi_dot)."""
    w2, k, c = pendulum.w2, pendulum.k, pendulum.c
    A = np.array(
        [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, w2, -c]]
    )
    return A, np.array([[0.0], [1.0], [0.0], [-k]])


def sampled(A: Array, B: Array, h: float) -> tuple[Array, Array]:
    """Return A and B of the sampled system, its one input held over a step of h [s]."""
    n = len(A)
    held = np.asarray(expm(h * np.block([[A, B], [np.zeros((1, n + 1))]])), np.float64)
    return held[:n, :n], held[:n, n:]


def lqr_gains(pendulum: PendulumParameters, h: float) -> tuple[float, float, float, float]:
    """Return the gains of the linear-quadratic regulator, u = gains . state.

    Sampled with u held over h. Weights by Bryson's rule: each of x, phi and u costs 1 at its limit.

    Raises:
        InputError: The pendulum falls too fast for the step.
    """
    A, B = state_space(pendulum)
    # Limit on h^2 w2: within a step of h the fall grows by a factor of e^3, past any balance.
    most = 9.0 / h**2
    if not pendulum.w2 < most:
        raise InputError(
            f"the pendulum falls too fast for a step of {h:g} s: w2 is {pendulum.w2:.3g} 1/s^2, "
            f"expected less than {most:.3g}; is its recording in seconds?"
        )
    A_h, B_h = sampled(A, B, h)
    phi_limit = math.radians(paper.PHI_LIMIT_DEG)
    Q = np.diag([1.0 / paper.X_LIMIT**2, 0.0, 1.0 / phi_limit**2, 0.0])
    R = np.array([[1.0 / max(paper.ACTIONS) ** 2]])
    try:
        P = solve_discrete_are(A_h, B_h, Q, R)
    except np.linalg.LinAlgError:
        raise InputError(
            f"no regulator balances a pendulum with w2 of {pendulum.w2:.3g} 1/s^2, c of "
            f"{pendulum.c:.3g} 1/s and k of {pendulum.k:.3g} 1/m; identify it again"
        ) from None
    K = np.linalg.solve(R + B_h.T @ P @ B_h, B_h.T @ P @ A_h)[0]
    x, x_dot, phi, phi_dot = (-float(gain) for gain in K)
    return x, x_dot, phi, phi_dot


def pd_gains(pendulum: PendulumParameters) -> tuple[float, float, float, float]:
    """Return the gains of a PD controller of phi alone, without regard to the track.

    Both poles of the pendulum are placed at -sqrt(w2), its own rate of fall.
    """
    w = math.sqrt(pendulum.w2)
    return 0.0, 0.0, 2.0 * pendulum.w2 / pendulum.k, (2.0 * w - pendulum.c) / pendulum.k


def observer_gains(
    pendulum: PendulumParameters, counts_per_rev: int, h: float, *, estimate_bias: bool = True
) -> Gains:
    """Return the stationary Kalman gains on phi [1], phi_dot [1/s] and the bias [1].

    Args:
        pendulum: Nominal parameters.
        counts_per_rev: Encoder counts per revolution.
        h: Time between ticks [s].
        estimate_bias: Whether the bias is estimated.
    """
    A = np.array([[0.0, 1.0, 0.0], [pendulum.w2, -pendulum.c, 0.0], [0.0, 0.0, 0.0]])
    G = np.array([[0.0], [1.0], [0.0]])
    F, held = sampled(A, G, h)
    g = held[:, 0]
    noise = ACCELERATION_SIGMA**2 * np.outer(g, g)
    noise[2, 2] = BIAS_DRIFT**2 * h
    H = np.array([[1.0, 0.0, 1.0]])
    variance = (2.0 * math.pi / counts_per_rev) ** 2 / 12.0 + ANGLE_SIGMA**2
    seen = slice(None) if estimate_bias else slice(2)
    P = solve_discrete_are(F[seen, seen].T, H[:, seen].T, noise[seen, seen], np.array([[variance]]))
    gains = np.zeros(3)
    gains[seen] = (P @ H[:, seen].T / (H[:, seen] @ P @ H[:, seen].T + variance))[:, 0]
    on_phi, on_phi_dot, on_bias = gains.tolist()
    return on_phi, on_phi_dot, on_bias
