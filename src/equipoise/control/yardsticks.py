"""Policies to measure a table against: LQR, LQR snapped to the eight actions, PD, random.

All know the pendulum's nominal parameters and see the same state as the table.
"""

import math

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm, solve_discrete_are

from equipoise import paper
from equipoise.control.policy import LINEAR, RANDOM, SNAPPED, PolicyKernel, policy_kernel
from equipoise.model.pendulum import PendulumParameters

Array = npt.NDArray[np.float64]


def yardsticks(pendulum: PendulumParameters, h: float) -> dict[str, PolicyKernel]:
    """Return the yardsticks by name.

    Args:
        pendulum: Nominal parameters.
        h: Time step [s].
    """
    gains = lqr_gains(pendulum, h)
    return {
        "LQR": policy_kernel(LINEAR, gains=gains),
        "LQR, snapped": policy_kernel(SNAPPED, gains=gains),
        "PD": policy_kernel(LINEAR, gains=pd_gains(pendulum)),
        "random": policy_kernel(RANDOM),
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
    """
    A, B = state_space(pendulum)
    held = expm(h * np.block([[A, B], [np.zeros((1, 5))]]))
    A_h, B_h = held[:4, :4], held[:4, 4:]
    phi_limit = math.radians(paper.PHI_LIMIT_DEG)
    Q = np.diag([1.0 / paper.X_LIMIT**2, 0.0, 1.0 / phi_limit**2, 0.0])
    R = np.array([[1.0 / max(paper.ACTIONS) ** 2]])
    P = solve_discrete_are(A_h, B_h, Q, R)
    K = np.linalg.solve(R + B_h.T @ P @ B_h, B_h.T @ P @ A_h)[0]
    x, x_dot, phi, phi_dot = (-float(gain) for gain in K)
    return x, x_dot, phi, phi_dot


def pd_gains(pendulum: PendulumParameters) -> tuple[float, float, float, float]:
    """Return the gains of a PD controller of phi alone, which does not know where the track ends.

    Both poles of the pendulum are placed at -sqrt(w2), its own rate of fall.
    """
    w = math.sqrt(pendulum.w2)
    return 0.0, 0.0, 2.0 * pendulum.w2 / pendulum.k, (2.0 * w - pendulum.c) / pendulum.k
