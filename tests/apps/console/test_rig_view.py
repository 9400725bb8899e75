"""The rig in a viser scene, without a browser."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa7, iiwa14

viser = pytest.importorskip("viser", reason="viser is not installed (extra console)")


@pytest.fixture
def server():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def view(server, arm):
    from equipoise.apps.console.rig_view import RigView

    return RigView(server, arm)


@pytest.mark.parametrize("make", [iiwa7, iiwa14])
def test_the_pivot_is_where_the_kinematics_of_the_arm_have_it(server, make):
    arm = make()
    rig = view(server, arm)
    q = np.array(arm.home) + np.array([0.1, -0.2, 0.0, 0.15, 0.1, -0.1, 0.3])
    rig.show(q, 0.1)
    pose, home = arm.pose(arm.without_held(q)), arm.pose(arm.home_free)
    expected = pose.position + pose.rotation @ np.array(arm.pivot)
    assert rig.pivot == pytest.approx(expected, abs=1e-9)
    at_home = home.position + home.rotation @ np.array(arm.pivot)
    assert rig.x == pytest.approx(expected[0] - at_home[0], abs=1e-9)


def test_the_ghost_stands_at_the_commanded_posture_and_goes_with_it(server):
    arm = iiwa7()
    rig = view(server, arm)
    q = np.array(arm.home)
    assert not rig._ghost
    rig.show(q, 0.0, commanded=q + 0.1)
    ghost, real = rig._ghost, rig._bodies
    assert all(frame.visible for frame, _ in ghost.values())
    assert set(real) - set(ghost) == {0}, "the table has no ghost"
    pendulum = rig._rig.model.body("pendulum").id
    assert np.linalg.norm(ghost[pendulum][0].position - real[pendulum][0].position) > 0.05
    rig.show(q + 0.1, 0.0, commanded=q + 0.1)
    assert ghost[pendulum][0].position == pytest.approx(real[pendulum][0].position)
    rig.show(q, 0.0)
    assert not any(frame.visible for frame, _ in ghost.values())


def test_an_unknown_posture_or_angle_keeps_the_last_one(server):
    arm = iiwa7()
    rig = view(server, arm)
    q = np.array(arm.home) + 0.05
    rig.show(q, 0.3)
    pivot, pendulum = rig.pivot, rig._rig.model.body("pendulum").id
    leaned = np.array(rig._bodies[pendulum][0].wxyz)
    rig.show(np.full(7, np.nan), np.nan, commanded=np.full(7, np.nan), u=np.nan)
    assert rig.pivot == pytest.approx(pivot)
    assert np.array(rig._bodies[pendulum][0].wxyz) == pytest.approx(leaned)
    assert not rig._ghost


def test_the_pendulum_leans_towards_x_for_a_positive_angle(server):
    from viser.transforms import SO3

    rig = view(server, iiwa7())
    rig.show(iiwa7().home, 0.2)
    number = rig._rig.model.body("pendulum").id
    direction = SO3(np.array(rig._bodies[number][0].wxyz)).as_matrix()[:, 2]
    assert direction == pytest.approx([np.sin(0.2), 0.0, np.cos(0.2)], abs=1e-9)


def test_an_acceleration_is_an_arrow_along_x_below_the_pivot(server):
    rig = view(server, iiwa7())
    rig.show(iiwa7().home, 0.0, u=-1.5)
    start, end = np.array(rig._arrow.points)[0]
    assert end - start == pytest.approx([-0.15, 0.0, 0.0], abs=1e-6)
    assert start[2] < rig.pivot[2]
    rig.show(iiwa7().home, 0.0)
    assert not rig._arrow.visible


def test_a_browser_sees_the_rig_from_the_camera_of_the_films_unless_it_turned_the_view(server):
    from equipoise.film import camera_axes

    rig = view(server, iiwa7())
    camera = SimpleNamespace(aspect=1.0, position=np.zeros(3))
    browser = SimpleNamespace(client_id=1, camera=camera, atomic=nullcontext)
    rig.keep_in_view(browser)
    near = camera.look_at - camera.position
    np.testing.assert_allclose(near / np.linalg.norm(near), camera_axes()[2], atol=1e-9)
    camera.aspect = 0.5  # a narrow window sees it from further away
    rig.keep_in_view(browser)
    far = camera.look_at - camera.position
    assert np.linalg.norm(far) > 1.5 * np.linalg.norm(near)
    turned = camera.position = camera.position + 0.1
    camera.aspect = 1.0
    rig.keep_in_view(browser)
    np.testing.assert_array_equal(camera.position, turned)
