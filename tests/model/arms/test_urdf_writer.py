"""Arms as URDF: read again they are the same arms, and other programs put the flange there, too."""

import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.urdf import read_urdf
from equipoise.model.arms.urdf_writer import write_urdf


@pytest.fixture(params=[7, 14])
def arm(request):
    return iiwa(request.param, media_flange=0.035)


def written(arm, tmp_path, **options):
    path = tmp_path / "arm.urdf"
    path.write_text(write_urdf(arm, **options))
    return path


@pytest.mark.parametrize("pendulum", [False, True])
def test_an_arm_comes_back(arm, tmp_path, pendulum):
    path = written(arm, tmp_path, pendulum=pendulum)
    back = read_urdf(
        path,
        tip="flange",
        held=arm.held_joint,
        held_angle=arm.held_angle,
        home=arm.home,
        pivot=arm.pivot,
        acceleration=arm.joints[0].acceleration,
    )
    assert back.name == arm.name
    for one, other in zip(back.joints, arm.joints, strict=True):
        assert one.name == other.name
        for name in ("xyz", "rpy", "axis"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-15)
        limits = ("lower", "upper", "velocity", "torque")
        assert [getattr(one, name) for name in limits] == [getattr(other, name) for name in limits]
    np.testing.assert_allclose(back.flange_xyz, arm.flange_xyz, atol=1e-15)
    q = arm.home_free + 0.1
    np.testing.assert_allclose(back.pose(q).position, arm.pose(q).position, atol=1e-12)
    np.testing.assert_allclose(back.pose(q).rotation, arm.pose(q).rotation, atol=1e-12)


def test_pinocchio_puts_flange_and_pendulum_there(arm):
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.buildModelFromXML(write_urdf(arm, pendulum=True))
    data = model.createData()
    rng = np.random.default_rng(1)
    for _ in range(5):
        free, phi = arm.home_free + 0.2 * rng.standard_normal(6), rng.uniform(-3.0, 3.0)
        # A continuous joint is cosine and sine of its angle there.
        q = np.concatenate((arm.with_held(free), [np.cos(phi), np.sin(phi)]))
        pinocchio.framesForwardKinematics(model, data, q)
        flange = data.oMf[model.getFrameId("flange")]
        pose = arm.pose(free)
        np.testing.assert_allclose(flange.translation, pose.position, atol=1e-12)
        np.testing.assert_allclose(flange.rotation, pose.rotation, atol=1e-12)
    q = np.concatenate((arm.home, [np.cos(0.3), np.sin(0.3)]))
    pinocchio.framesForwardKinematics(model, data, q)
    rod = data.oMf[model.getFrameId("pendulum", pinocchio.FrameType.BODY)].rotation @ [
        0.0,
        0.0,
        1.0,
    ]
    np.testing.assert_allclose(rod, [np.sin(0.3), 0.0, np.cos(0.3)], atol=1e-12)
