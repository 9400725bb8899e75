"""experiments/recoverable.py against closed forms."""

import numpy as np
import pytest

from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import GRAVITY
from tests.test_experiments import module

SET = module("recoverable")
RecoveryParams = SET["RecoveryParams"]
largest_start, response_delay = SET["largest_start"], SET["response_delay"]

PENDULUMS = [(25.0, 0.01), (70.2, 0.15), (140.0, 0.6)]


def params(w2, c, **more):
    pendulum = PendulumParameters(w2, w2 / GRAVITY, c, linearised=True)
    return RecoveryParams(pendulum, 0.0, **more)


@pytest.mark.parametrize(("w2", "c"), PENDULUMS)
def test_without_ends_of_track_and_angle_the_limit_is_that_of_the_closed_form(w2, c):
    free = params(w2, c, x_limit=1e3, phi_limit=1.0)
    direction = np.array([0.0, 0.0, 1.0, 0.0])
    closed = free.u_max / GRAVITY
    assert free.largest == pytest.approx(closed, rel=1e-12)
    assert largest_start(free, direction) == pytest.approx(closed, rel=1e-3)
    assert largest_start(free._replace(x_limit=0.22), direction) < 0.97 * closed


def test_the_delay_of_a_lag_is_the_sum_of_transport_and_lag():
    rate = 8.0
    actuator = Actuator.assumed("lag", delay=0.03, lag=0.02)
    # The setpoint of an interval is the place at its end, held: half an interval early.
    expected = 0.03 + np.log1p(rate * 0.02) / rate - 0.0025
    assert response_delay(iiwa(7), actuator, rate) == pytest.approx(expected, abs=0.001)
    assert response_delay(iiwa(7), IDEAL_ACTUATOR, rate) == 0.0
