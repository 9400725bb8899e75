"""Gains of baselines and observer against independent recursions."""

from math import pi, sqrt

import numpy as np
import pytest
from scipy.signal import cont2discrete

from equipoise.control.linear import lqr_gains, observer_gains, pd_gains
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import ControllerSettings
from tests.reference.closed_loop import gains as slow_gains

H = 0.01
PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
OTHERS = [
    PENDULUM,
    PendulumParameters(w2=20.0, k=2.0, c=0.0),
    PendulumParameters(w2=150.0, k=16.0, c=1.0),
]


def nominal(pendulum):
    """Return A and B of equation (7), typed from the paper."""
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[3, 2], A[3, 3] = pendulum.w2, -pendulum.c
    return A, np.array([[0.0], [1.0], [0.0], [-pendulum.k]])


@pytest.mark.parametrize("pendulum", OTHERS, ids=str)
def test_gains_are_those_to_which_the_riccati_recursion_converges(pendulum):
    A, B, *_ = cont2discrete((*nominal(pendulum), np.eye(4), np.zeros((4, 1))), H)
    Q = np.diag([1 / 0.22**2, 0.0, 1 / (11 * pi / 180) ** 2, 0.0])
    R = 1 / 2.0**2
    P = Q.copy()
    for _ in range(3_000):
        K = (B.T @ P @ A) / (R + (B.T @ P @ B).item())
        P = Q + A.T @ P @ (A - B @ K)
        P = 0.5 * (P + P.T)
    # Three thousand steps are 30 s, and the recursion forgets with the slowest pole, in 1 s.
    np.testing.assert_allclose(lqr_gains(pendulum, H), -K[0], rtol=1e-7)


@pytest.mark.parametrize("pendulum", OTHERS, ids=str)
def test_pd_puts_both_poles_of_the_pendulum_at_its_own_rate_of_fall(pendulum):
    _, _, on_phi, on_phi_dot = pd_gains(pendulum)
    assert pd_gains(pendulum)[:2] == (0.0, 0.0)
    # phi_ddot = (w2 - k on_phi) phi - (c + k on_phi_dot) phi_dot = -(s + w)^2 at s = 0.
    w = sqrt(pendulum.w2)
    assert pendulum.k * on_phi - pendulum.w2 == pytest.approx(w**2)
    assert pendulum.k * on_phi_dot + pendulum.c == pytest.approx(2 * w)


@pytest.mark.parametrize(
    ("pendulum", "counts"), list(zip(OTHERS, [8192, 4096, 100_000], strict=True)), ids=str
)
@pytest.mark.parametrize("estimates_bias", [True, False])
def test_gains_of_the_observer_are_those_to_which_the_riccati_recursion_converges(
    pendulum, counts, estimates_bias
):
    settings = ControllerSettings(estimate_bias=estimates_bias)
    ours = observer_gains(pendulum, counts, H, estimate_bias=estimates_bias)
    # 1e-9: the recursion stops at changes of 1e-13, a thousandth of what is then left.
    np.testing.assert_allclose(ours, slow_gains(pendulum, settings, counts, H), rtol=1e-9)
    assert (ours[2] == 0.0) == (not estimates_bias)
