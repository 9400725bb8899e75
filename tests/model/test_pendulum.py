"""The pendulum's kernels against SciPy's integrator, closed forms and invariants."""

from math import pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ellipk

from equipoise import paper
from equipoise.model.pendulum import Pendulum, PendulumParameters, step, swing
from tests.reference import pendulum as reference

W2, K = 70.2, 7.15


def swung(time, theta, theta_dot, h, pendulum):
    return swing(np.asarray(time, dtype=float), theta, theta_dot, h, pendulum)


def stepped(phi, phi_dot, u, h, n, pendulum):
    for _ in range(n):
        phi, phi_dot = step(phi, phi_dot, u, h, pendulum)
    return phi, phi_dot


FRICTIONS = [
    {"c": 0.15},
    {"c": 0.15, "drag": 0.02},
    {"c": 0.15, "coulomb": 2.0},
    {"c": 0.05, "coulomb": 1.0, "drag": 0.02},
]


@pytest.mark.parametrize("friction", FRICTIONS)
def test_step_converges_with_order_four_also_where_dry_friction_turns_round(friction):
    pendulum = PendulumParameters(w2=W2, k=K, **friction)
    theta, _ = reference.swing([0.0, 1.2], 1.2, 0.0, w2=W2, **friction)
    errors = []
    for n in (60, 120, 240):
        phi, _ = stepped(pi - 1.2, 0.0, 0.0, 1.2 / n, n, pendulum)
        errors.append(abs(pi - phi - theta[-1]))
    # Order 4 divides the error by 16 with every halving; a little less far from the limit.
    assert errors[0] / errors[1] > 12.0
    assert errors[1] / errors[2] > 12.0


@pytest.mark.parametrize("friction", FRICTIONS)
def test_swing_equals_an_adaptive_integrator_at_uneven_times_and_across_gaps(friction):
    rng = np.random.default_rng(3)
    time = np.sort(np.concatenate((rng.uniform(0.0, 2.0, 300), rng.uniform(2.6, 5.0, 200))))
    expected = reference.swing(time, -1.7, 0.4, w2=W2, **friction)
    h = 2.0 * pi / sqrt(W2) / 256
    found = swung(time, -1.7, 0.4, h, PendulumParameters(w2=W2, k=K, **friction))
    # (sqrt(w2) h)^4 / 120 per radian of phase, 40 rad: about 1e-7 rad; the cubic's slope 1e-5.
    np.testing.assert_allclose(found[0], expected[0], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1], rtol=0.0, atol=3e-5)


@pytest.mark.parametrize("amplitude", [0.1, 1.0, 2.0, 3.0])
def test_a_large_swing_has_the_period_of_the_elliptic_integral(amplitude):
    period = 4.0 * ellipk(sin(amplitude / 2.0) ** 2) / sqrt(W2)
    theta, theta_dot = swung([0.0, period], amplitude, 0.0, 1e-3, PendulumParameters(W2, K, 0.0))
    assert theta[-1] == pytest.approx(amplitude, abs=1e-7)
    assert theta_dot[-1] == pytest.approx(0.0, abs=1e-5)


def test_a_pushed_pivot_leaves_the_pendulum_behind():
    # Equation (7): phi_ddot = -k u at rest upright; far from upright with cos(phi).
    pendulum = PendulumParameters(W2, K, 0.0)

    def acceleration(phi):
        return stepped(phi, 0.0, 2.0, 1e-6, 1, pendulum)[1] / 1e-6

    assert acceleration(0.0) == pytest.approx(-2.0 * K)
    assert acceleration(pi) == pytest.approx(2.0 * K)
    # It stays where gravity and the pivot's acceleration balance: tan(phi) = u / g.
    lean = np.arctan(2.0 * K / W2)
    assert acceleration(lean) == pytest.approx(0.0, abs=1e-6)


def test_dry_friction_holds_the_pendulum_where_gravity_is_weaker():
    pendulum = PendulumParameters(W2, K, 0.0, 2.0)
    held, moves = 0.99 * 2.0 / W2, 1.01 * 2.0 / W2
    assert step(pi - held, 0.0, 0.0, 0.01, pendulum) == (pi - held, 0.0)
    assert step(pi - moves, 0.0, 0.0, 0.01, pendulum)[0] > pi - moves
    # Pushed hard enough by the pivot, the held one moves too.
    assert step(pi - held, 0.0, 2.0, 0.01, pendulum)[1] != 0.0


@given(
    phi=st.floats(-4.0, 4.0), rate=st.floats(-3.0, 3.0), w2=st.floats(10.0, 150.0),
    c=st.floats(0.0, 1.0), coulomb=st.floats(0.0, 3.0), drag=st.floats(0.0, 0.1),
)  # fmt: skip
def test_without_push_the_energy_never_grows(phi, rate, w2, c, coulomb, drag):
    pendulum = PendulumParameters(w2, w2 / 9.81, c, coulomb, drag)
    phi_dot, h = rate * sqrt(w2), 0.02 / sqrt(w2)
    energy = phi_dot**2 / (2.0 * w2) + np.cos(phi)
    for _ in range(300):
        phi, phi_dot = step(phi, phi_dot, 0.0, h, pendulum)
        now = phi_dot**2 / (2.0 * w2) + np.cos(phi)
        # At up to 3 sqrt(w2) a step turns by 0.06 rad; taken with order 4 it may be wrong by
        # 0.06^5 / 120 of the energy.
        assert now <= energy + 1e-8
        energy = now


@given(
    phi=st.floats(-3.0, 3.0), phi_dot=st.floats(-10.0, 10.0), u=st.floats(-2.0, 2.0),
    coulomb=st.sampled_from([0.0, 0.8]), linearised=st.booleans(),
)  # fmt: skip
def test_the_mirrored_pendulum_moves_mirrored(phi, phi_dot, u, coulomb, linearised):
    pendulum = PendulumParameters(W2, K, 0.15, coulomb, 0.01, linearised)
    right = step(phi, phi_dot, u, 0.01, pendulum)
    left = step(-phi, -phi_dot, -u, 0.01, pendulum)
    assert right == (-left[0], -left[1])


def test_the_papers_period_belongs_to_the_papers_pendulum():
    pendulum = Pendulum.assumed(W2, 0.15)
    assert pendulum.period == pytest.approx(paper.FREE_SWING_PERIOD, rel=1e-3)
    parameters = pendulum.parameters()
    assert parameters == (W2, W2 / pendulum.g, 0.15, 0.0, 0.0, False)
    assert pendulum.parameters(linearised=True).linearised
    assert parameters.k == pytest.approx(W2 / 9.80665)
