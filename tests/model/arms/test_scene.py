"""The home posture in MuJoCo: what comes close to what."""

import mujoco
import numpy as np
import pytest

from equipoise.model.arms.iiwa import MEDIA_FLANGES, iiwa
from equipoise.model.arms.scene import scene
from tests.model.arms.clearance import clearance
from tests.model.arms.witnesses import ARMS


@pytest.mark.parametrize("size", [7, 14])
@pytest.mark.parametrize("media_flange", MEDIA_FLANGES)
def test_nothing_touches_the_arm_or_comes_near_the_table(size, media_flange):
    closest = clearance(iiwa(size, media_flange=media_flange))
    assert closest.arm > 0.0
    assert closest.table >= 0.05


@pytest.mark.parametrize("name", ARMS)
def test_mujoco_puts_the_flange_where_the_arm_says(name):
    arm, _ = ARMS[name]
    model = scene(arm).compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    for _ in range(20):
        q = rng.uniform(-1.0, 1.0, 6)
        data.qpos[:-1] = arm.with_held(q)
        mujoco.mj_kinematics(model, data)
        pose = arm.pose(q)
        assert data.body("flange").xpos == pytest.approx(pose.position, abs=1e-12)
        assert data.body("flange").xmat == pytest.approx(pose.rotation.ravel(), abs=1e-12)


def test_phi_tips_the_pendulum_towards_x_in_a_plane_beside_the_arm():
    arm = iiwa(7)
    model = scene(arm).compile()
    data = mujoco.MjData(model)
    for phi in (0.0, 0.3, np.pi):
        data.qpos[:] = [*arm.home, phi]
        mujoco.mj_kinematics(model, data)
        rod = data.body("pendulum").xmat.reshape(3, 3)[:, 2]
        assert rod == pytest.approx([np.sin(phi), 0.0, np.cos(phi)], abs=1e-12)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    assert data.qpos == pytest.approx([*arm.home, np.pi])
