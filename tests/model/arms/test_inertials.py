"""Masses and inertias against MuJoCo and Pinocchio, which read them from the public chain."""

import numpy as np
import pytest

from equipoise.errors import ArmError
from equipoise.model.arms.iiwa import MEDIA_FLANGES, iiwa
from equipoise.model.arms.inertials import link_inertials
from equipoise.model.arms.urdf import read_urdf
from tests.model.arms.weighed import GRAVITY, PUBLISHED, TOTAL, by_mujoco, by_pinocchio
from tests.model.arms.witnesses import ELBOW, ELBOW_HOME


def turn(axis, angle):
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def summed_over_links(arm, q):
    """M and the torques that hold the arm, link by link: sum of m Jv'Jv + Jw' I Jw, -m Jv'g."""
    M, torque = np.zeros((7, 7)), np.zeros(7)
    origin, rotation = np.zeros(3), np.eye(3)
    axes, origins = [], []
    for joint, angle, link in zip(arm.joints, q, link_inertials(arm), strict=True):
        origin = origin + rotation @ joint.xyz
        for axis, part in zip(np.eye(3), joint.rpy, strict=True):
            rotation = rotation @ turn(axis, part)
        rotation = rotation @ turn(joint.axis, angle)
        axes.append(rotation @ joint.axis)
        origins.append(origin)
        com = origin + rotation @ link.com
        linear, angular = np.zeros((3, 7)), np.zeros((3, 7))
        for i, (axis, place) in enumerate(zip(axes, origins, strict=True)):
            linear[:, i], angular[:, i] = np.cross(axis, com - place), axis
        inertia = rotation @ link.inertia @ rotation.T
        M += link.mass * linear.T @ linear + angular.T @ inertia @ angular
        torque -= link.mass * linear.T @ GRAVITY
    return M, torque


@pytest.mark.parametrize("size", [7, 14])
@pytest.mark.parametrize("library", [by_mujoco, by_pinocchio])
def test_mass_matrix_and_gravity_are_those_of_the_public_chain(size, library):
    arm = iiwa(size)
    rng = np.random.default_rng(size)
    for _ in range(10):
        q = rng.uniform(-2.0, 2.0, 7)
        expected_M, expected_torque = library(size, q)
        M, torque = summed_over_links(arm, q)
        # MuJoCo keeps principal inertias, to some 1e-7 of what the file says.
        assert pytest.approx(expected_M, abs=1e-6) == M
        assert torque == pytest.approx(expected_torque, abs=1e-6)


@pytest.mark.parametrize("size", [7, 14])
def test_the_links_weigh_what_the_robot_weighs_without_its_base(size):
    base = float(PUBLISHED[size].split("|")[1])
    moving = sum(link.mass for link in link_inertials(iiwa(size)))
    assert moving + base == pytest.approx(TOTAL[size], abs=1e-6)


def test_home_pivot_and_held_joint_do_not_change_the_links():
    arm = iiwa(7, media_flange=MEDIA_FLANGES[2])
    home = (0.1, 0.2, 0.0, -0.5, 0.1, 0.6, 0.3)
    moved = arm.model_copy(update={"home": home, "held_joint": 7, "held_angle": 0.3})
    for here, there in zip(link_inertials(iiwa(7)), link_inertials(moved), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(here, there, strict=True))


def test_the_links_of_an_arm_from_a_urdf_are_not_known():
    arm = read_urdf(ELBOW, home=ELBOW_HOME)
    with pytest.raises(ArmError, match=f"{arm.name} are not known.*iiwa7 and iiwa14"):
        link_inertials(arm)
