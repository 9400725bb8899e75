"""The excitation: safe for the arm, rich for the identification; and its record."""

import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.worlds.twin.excitation import PERIOD, excitation

PENDULUM = PendulumParameters(w2=70.2, k=7.16, c=0.15)


@pytest.mark.parametrize(("size", "duration"), [(7, 10.0), (14, 3.0)])
def test_it_starts_and_ends_at_rest_at_home_and_keeps_within_the_limits(size, duration):
    arm = iiwa(size)
    q = excitation(arm, duration=duration)
    assert q.shape == (round(duration / PERIOD) + 1, 6)
    assert q[[0, -1]] == pytest.approx(np.array([arm.home_free] * 2), abs=1e-12)
    velocity = np.diff(q, axis=0) / PERIOD
    acceleration = np.diff(velocity, axis=0) / PERIOD
    assert np.abs(velocity[[0, -1]]).max() < 0.01
    for i, joint in enumerate(arm.free_joints):
        assert np.abs(velocity[:, i]).max() < 0.81 * joint.velocity
        assert np.abs(acceleration[:, i]).max() < 0.81 * joint.acceleration
    places = (
        np.array([arm.kinematics(row).position for row in q[::10]]) - arm.kinematics(q[0]).position
    )
    assert np.abs(places).max() < 0.05
