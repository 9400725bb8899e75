"""The drawing as a URDF: another program puts flange and pendulum where the arm says."""

import numpy as np
import pytest

from equipoise.model.arms.scene import scene
from equipoise.model.arms.urdf_writer import write_urdf
from tests.model.arms.witnesses import ARMS, Pinocchio


@pytest.mark.full
@pytest.mark.parametrize("name", ARMS)
def test_pinocchio_puts_flange_and_pendulum_there(name):
    arm, _ = ARMS[name]
    robot = Pinocchio(write_urdf(scene(arm)))
    rng, rest = np.random.default_rng(1), np.zeros(len(arm.joints) + 1)
    for _ in range(5):
        q = arm.home_free + 0.2 * rng.standard_normal(6)
        flange, ours = robot.flange([*arm.with_held(q), 0.5], rest), arm.kinematics(q)
        np.testing.assert_allclose(flange.position, ours.position, atol=1e-12)
        np.testing.assert_allclose(flange.rotation, ours.rotation, atol=1e-12)
    robot.flange([*arm.home, 0.3], rest)
    rod = robot.data.oMf[robot.model.getFrameId("pendulum")]
    pivot = ours_at_home(arm)
    np.testing.assert_allclose(rod.translation, pivot, atol=1e-12)
    np.testing.assert_allclose(rod.rotation[:, 2], [np.sin(0.3), 0.0, np.cos(0.3)], atol=1e-12)


def ours_at_home(arm):
    """Return the pivot of the pendulum at home [m]."""
    flange = arm.kinematics(arm.home_free)
    return flange.position + flange.rotation @ arm.pivot
