"""The home posture in MuJoCo: what comes close to what, and arms with short steps."""

import mujoco
import numpy as np
import pytest

from equipoise.arm.iiwa import iiwa
from equipoise.arm.posture import along_x
from equipoise.arm.scene import scene
from equipoise.film import build_scene
from equipoise.paper import X_LIMIT
from equipoise.simulation.twin.physics import build_bare
from tests.arm.witnesses import ARMS
from tests.arms import with_step

ELBOW = ARMS["elbow6"][0]

LENGTHS = (0.0, 1e-17, 1e-16, 1e-9, 1e-3, 0.006, 0.045, 0.0595, 0.06, 0.061, 0.07, 0.2)
"""Steps of public arms [m], rounding noise, and lengths around twice the inset of a link."""


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


def drawn_shapes(arm):
    """Return name and size of every capsule of the drawing."""
    return {
        geom.name: geom.size[0]
        for geom in scene(arm).geoms
        if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE
    }


@pytest.mark.parametrize("length", LENGTHS)
def test_a_step_of_any_length_is_drawn_where_the_kinematics_puts_it(length):
    for step in (2, 6, 7, 8):  # two joints, the last two, the flange, the pivot
        arm = with_step(ELBOW, step, length)
        model = scene(arm).compile()
        data = mujoco.MjData(model)
        q = 0.5 * arm.home_free
        data.qpos[:] = [*q, 0.0]
        mujoco.mj_kinematics(model, data)
        flange = arm.kinematics(q)
        np.testing.assert_allclose(data.body("flange").xpos, flange.position, atol=1e-14)
        pivot = flange.position + flange.rotation @ arm.pivot
        np.testing.assert_allclose(data.body("pendulum").xpos, pivot, atol=1e-14)
        # The film and the twin have the same frames.
        assert build_scene(arm).model.nq == build_bare(arm).nq + 1 == 7


@pytest.mark.parametrize("noise", [1e-17, 1e-16, 1e-9])
@pytest.mark.parametrize("step", range(1, 9))
def test_rounding_in_an_origin_changes_no_shape(step, noise):
    clean, noisy = (with_step(ELBOW, step, length) for length in (0.0, noise))
    assert drawn_shapes(noisy) == pytest.approx(drawn_shapes(clean))


def test_a_small_arm_is_drawn_in_proportion():
    small = ELBOW
    for number in range(1, 8):
        small = with_step(small, number, 0.1)
    assert drawn_shapes(iiwa(7))["link 2"] == pytest.approx(0.11)
    assert drawn_shapes(small)["link 2"] == pytest.approx(0.11 * 0.7 / 1.2)
