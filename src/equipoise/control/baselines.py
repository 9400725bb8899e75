"""Baseline policies: LQR, LQR snapped to the eight actions, PD, random.

They use the pendulum's nominal parameters and the same observation as the table.
"""

import math

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.policy import LINEAR, RANDOM, SNAPPED, PolicyKernel
from equipoise.errors import InputError
from equipoise.model.pendulum import PendulumParameters


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
    held = expm(h * np.block([[A, B], [np.zeros((1, 5))]]))
    A_h, B_h = held[:4, :4], held[:4, 4:]
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
