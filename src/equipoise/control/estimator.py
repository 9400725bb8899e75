r"""Gains of the observer that turns encoder counts into phi, phi_dot and the bias of phi.

Between two ticks the observer moves its estimate by the pendulum's own equation, driven by the
acceleration of the pivot; then the newest count corrects it:

.. math:: \hat s \leftarrow \hat s + L\,(y - \hat\varphi - \hat\beta), \qquad
          \hat s = (\hat\varphi, \hat{\dot\varphi}, \hat\beta)

The bias beta is the encoder's zero offset. A balanced pendulum is upright on average: a persistent
lean would require a mean acceleration of the pivot of g beta. That makes beta observable; it may
drift slowly.

L is the stationary Kalman gain at upright. The observer needs no window of past counts, and uses
each count at its own time (`equipoise.control.control_step` has the formulas).
"""

from math import pi, radians
from typing import Final

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from equipoise.model.pendulum import PendulumParameters

Gains = tuple[float, float, float]

ACCELERATION_SIGMA: Final = 1.5
"""Standard deviation of the disturbance of phi_ddot [rad/s^2]: dry friction, and an error of
0.2 m/s^2 in the pivot's acceleration."""
ANGLE_SIGMA: Final = 3e-4
"""Standard deviation of a measured angle beyond the encoder's quantization [rad]: an error of
0.3 ms in a time stamp at 1 rad/s. A sensor with an error of 0.1 rad (6 deg) is useless within
11 deg."""
BIAS_DRIFT: Final = radians(0.05)
"""Drift of the bias in one second [rad], which sets the speed of the zero estimation."""


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
    held = expm(h * np.block([[A, G], [np.zeros((1, 4))]]))
    F, g = held[:3, :3], held[:3, 3]
    noise = ACCELERATION_SIGMA**2 * np.outer(g, g)
    noise[2, 2] = BIAS_DRIFT**2 * h
    H = np.array([[1.0, 0.0, 1.0]])
    variance = (2.0 * pi / counts_per_rev) ** 2 / 12.0 + ANGLE_SIGMA**2
    seen = slice(None) if estimate_bias else slice(2)
    P = solve_discrete_are(F[seen, seen].T, H[:, seen].T, noise[seen, seen], np.array([[variance]]))
    gains = np.zeros(3)
    gains[seen] = (P @ H[:, seen].T / (H[:, seen] @ P @ H[:, seen].T + variance))[:, 0]
    on_phi, on_phi_dot, on_bias = gains.tolist()
    return on_phi, on_phi_dot, on_bias
