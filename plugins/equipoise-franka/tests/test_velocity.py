"""The stream of velocities keeps every limit of the controller, and comes where the path goes."""

import numpy as np
import pytest

from equipoise_franka import velocity
from equipoise_franka.velocity import PERIOD, SHARE, velocity_limits

SLACK = 0.02  # [rad/s]: a braking joint follows its falling limit by two cycles
HOME = np.array([0.0, -0.7, 0.0, -2.4, 0.0, 1.6, 0.8])


def streamed(desired, q=HOME):
    """Return velocities for desired ones from rest, and their limits at each posture [rad/s]."""
    v, last, bounds = [np.zeros(7)], [np.zeros(7)], [velocity_limits(q)]
    for one in desired:
        v.append(velocity.limited(one, v[-1], last[-1], bounds[-1]))
        last.append((v[-1] - v[-2]) / PERIOD)
        q = q + PERIOD * v[-1]
        bounds.append(velocity_limits(q))
    return np.array(v), np.array(bounds) / SHARE


@pytest.mark.parametrize("seed", range(5))
def test_any_desired_velocities_keep_the_limits(seed):
    random = np.random.default_rng(seed)
    desired = np.repeat(random.normal(0.0, 3.0, (300, 7)), random.integers(1, 40, 300), axis=0)
    v, bounds = streamed(desired)
    a = np.diff(v, axis=0) / PERIOD
    jerk = np.diff(a, axis=0, prepend=0.0) / PERIOD
    assert (np.abs(v) <= velocity.VELOCITY).all()
    assert (v >= bounds[:, 0] - SLACK).all()
    assert (v <= bounds[:, 1] + SLACK).all()
    assert np.abs(a).max() <= velocity.ACCELERATION
    assert np.abs(jerk).max() <= velocity.JERK
    assert np.abs(jerk).max() > 0.9 * SHARE * velocity.JERK, "the limits were not reached"


def test_a_joint_can_stop_before_the_end_of_its_range():
    """A braking at the controller's deceleration ends before the limit, wherever it begins."""
    for fraction in np.linspace(0.0, 1.0, 50):
        q = velocity.LOWER + fraction * (velocity.UPPER - velocity.LOWER)
        low, high = velocity_limits(q)
        assert (low <= 0.0).all()
        assert (high >= 0.0).all()
        assert (high <= SHARE * velocity.VELOCITY).all()
    assert velocity_limits(velocity.UPPER)[1] == pytest.approx(np.zeros(7))
    assert (velocity.OFFSET > 0.0).all()
