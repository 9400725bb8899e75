"""experiments/recoverable.py against closed forms, SciPy's integrator and brute force."""

from itertools import combinations_with_replacement

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equipoise import PendulumParameters, iiwa
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.settings import GRAVITY
from tests.test_experiments import module

SET = module("recoverable")
RecoveryParams, fall = SET["RecoveryParams"], SET["fall"]
largest_start, response_delay = SET["largest_start"], SET["response_delay"]

PENDULUMS = [(25.0, 0.01), (70.2, 0.15), (140.0, 0.6)]


def params(w2=70.2, c=0.15, **more):
    fields = {"linearised": more.pop("linearised", False), "coulomb": more.pop("coulomb", 0.0)}
    pendulum = PendulumParameters(w2, w2 / GRAVITY, c, **fields)
    return RecoveryParams(pendulum, more.pop("delay", 0.0), **more)


@pytest.mark.parametrize(("w2", "c"), PENDULUMS)
def test_without_ends_of_track_and_angle_the_limit_is_that_of_the_closed_form(w2, c):
    free = params(w2, c, linearised=True, x_limit=1e3, phi_limit=1.0)
    direction = np.array([0.0, 0.0, 1.0, 0.0])
    closed = free.u_max / GRAVITY
    assert free.largest == pytest.approx(closed, rel=1e-12)
    assert largest_start(free, direction) == pytest.approx(closed, rel=1e-3)
    assert largest_start(free._replace(x_limit=0.22), direction) < 0.97 * closed


@pytest.mark.parametrize(("w2", "c"), PENDULUMS)
@pytest.mark.parametrize("coulomb", [0.0, 1.0])
@pytest.mark.full
def test_no_bang_bang_command_recovers_a_start_outside_the_set_and_one_does_inside(w2, c, coulomb):
    """All commands with three switches, on a grid of 20 ms, on the nonlinear pendulum."""
    given, direction = params(w2, c, coulomb=coulomb), np.array([0.0, 0.0, 0.04, 0.31])
    limit = largest_start(given, direction)
    assert not survive(given, 1.01 * limit * direction)
    if coulomb == 0.0:
        assert survive(given, 0.95 * limit * direction)


def survive(given, start):
    """Whether any command survives; its last part is as long as the time."""
    w2, k, c, f = given.pendulum[:4]
    ticks, length = round(5.0 / given.rate / 0.02), 0.02
    switches = np.array(list(combinations_with_replacement(range(ticks + 1), 3)))
    x, v, phi, phi_dot = (np.full(len(switches), value) for value in start)
    alive = np.ones(len(switches), bool)
    for tick in range(ticks):
        u = given.u_max * (-1.0) ** np.sum(tick >= switches, axis=1)
        for _ in range(20):
            h = length / 20
            a = w2 * np.sin(phi) - c * phi_dot - f * np.sign(phi_dot) - k * u * np.cos(phi)
            phi_dot = phi_dot + h * a
            phi = phi + h * phi_dot
        x, v = x + length * v + 0.5 * length**2 * u, v + length * u
        alive &= (np.abs(x) < given.x_limit) & (np.abs(phi) < given.phi_limit)
    return bool(alive.any())


def test_the_fall_over_the_delay_is_that_of_scipys_integrator():
    given = params(delay=0.04, coulomb=0.5)
    w2, _, c, f = given.pendulum[:4]

    def motion(_, s):
        return [s[1], w2 * np.sin(s[0]) - c * s[1] - f * np.sign(s[1])]

    done = solve_ivp(motion, (0.0, 0.04), (0.04, 0.3), rtol=1e-10, atol=1e-12)
    found = fall(given, np.array([[0.01, 0.1, 0.04, 0.3]]))[0]
    assert found == pytest.approx([0.014, 0.1, *done.y[:, -1]], abs=1e-6)
    back = fall(given._replace(pendulum=given.pendulum._replace(coulomb=0.0)), found[None], -0.04)
    assert back.shape == (1, 4)


def test_the_delay_of_a_lag_is_the_sum_of_transport_and_lag():
    rate = 8.0
    actuator = Actuator.assumed("lag", delay=0.03, lag=0.02)
    # The setpoint of an interval is the place at its end, held: half an interval early.
    expected = 0.03 + np.log1p(rate * 0.02) / rate - 0.0025
    assert response_delay(iiwa(7), actuator, rate) == pytest.approx(expected, abs=0.001)
    assert response_delay(iiwa(7), IDEAL_ACTUATOR, rate) == 0.0
