"""The home posture in MuJoCo: what comes close to what."""

import mujoco
import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.posture import along_x
from equipoise.model.arms.scene import scene
from equipoise.paper import X_LIMIT
from tests.model.arms.witnesses import ARMS


@pytest.mark.parametrize("size", [7, 14])
def test_the_pendulum_turns_clear_of_arm_and_table(size):
    arm = iiwa(size)
    model = scene(arm).compile()
    data = mujoco.MjData(model)
    rod, bracket = model.geom("rod").id, model.geom("bracket").id
    for q in along_x(arm, [-X_LIMIT, 0.0, X_LIMIT]):
        for phi in np.radians(np.arange(0.0, 360.0, 10.0)):
            data.qpos[:] = [*arm.with_held(q), phi]
            mujoco.mj_kinematics(model, data)
            nearest = min(
                mujoco.mj_geomDistance(model, data, rod, other, 10.0, None)
                for other in set(range(model.ngeom)) - {rod, bracket}
            )
            assert nearest > 0.0


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
        pose = arm.kinematics(q)
        assert data.body("flange").xpos == pytest.approx(pose.position, abs=1e-12)
        assert data.body("flange").xmat == pytest.approx(pose.rotation.ravel(), abs=1e-12)
