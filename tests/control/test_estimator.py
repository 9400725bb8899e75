"""Gains of the observer against an independent recursion, and against all other gains."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from equipoise.control.estimator import (
    ACCELERATION_SIGMA,
    ANGLE_SIGMA,
    BIAS_DRIFT,
    observer_gains,
)
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import ControllerSettings
from tests.reference.closed_loop import gains as slow_gains

H = 0.01
PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
PENDULA = [
    PENDULUM,
    PendulumParameters(w2=20.0, k=2.0, c=0.0),
    PendulumParameters(w2=150.0, k=16.0, c=1.0),
]


def errors(gains, *, counts=8192):
    """Return the variances of phi, phi_dot and bias that any gains leave, from Lyapunov's equation.

    The error of the estimate moves by (1 - L C) F and is shaken by process and measurement.
    """
    A = np.array([[0.0, 1.0, 0.0], [PENDULUM.w2, -PENDULUM.c, 0.0], [0.0, 0.0, 0.0]])
    F = expm(A * H)
    # The acceleration is held over a step: its effect is the integral of the second column.
    fine = expm(A * ((np.arange(100) + 0.5) * H / 100)[:, None, None])[:, :, 1]
    shaken = ACCELERATION_SIGMA * H * np.mean(fine, axis=0)
    N = np.outer(shaken, shaken)
    N[2, 2] = BIAS_DRIFT**2 * H
    R = (2.0 * np.pi / counts) ** 2 / 12.0 + ANGLE_SIGMA**2
    L, C = np.array(gains)[:, None], np.array([[1.0, 0.0, 1.0]])
    keep = np.eye(3) - L @ C
    assert np.abs(np.linalg.eigvals(keep @ F)).max() < 1.0
    return np.diag(solve_discrete_lyapunov(keep @ F, keep @ N @ keep.T + R * L @ L.T))


@pytest.mark.parametrize("pendulum", PENDULA, ids=str)
@pytest.mark.parametrize("counts", [4096, 8192, 100_000])
@pytest.mark.parametrize("estimates_bias", [True, False])
def test_gains_are_those_to_which_the_riccati_recursion_converges(pendulum, counts, estimates_bias):
    settings = ControllerSettings(estimate_bias=estimates_bias)
    ours = observer_gains(pendulum, counts, H, estimate_bias=estimates_bias)
    # 1e-9: the recursion stops at changes of 1e-13, a thousandth of what is then left.
    np.testing.assert_allclose(ours, slow_gains(pendulum, settings, counts, H), rtol=1e-9)
    assert (ours[2] == 0.0) == (not estimates_bias)


def test_no_other_gains_leave_smaller_errors():
    gains = np.array(observer_gains(PENDULUM, 8192, H))
    best = errors(gains)
    for i in range(3):
        for factor in (0.8, 0.95, 1.05, 1.2):
            other = gains.copy()
            other[i] *= factor
            assert np.all(errors(other) >= best * (1.0 - 1e-9))
