"""The home posture in MuJoCo: what comes close to what."""

import mujoco
import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.posture import along_x
from equipoise.model.arms.scene import scene
from equipoise.paper import X_LIMIT


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
