"""Masses and inertias against MuJoCo and Pinocchio, which read them from URDFs."""

import numpy as np
import pytest

from equipoise.errors import ArmError
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.inertials import inertia_matrix, link_inertials
from equipoise.model.arms.urdf import read_urdf
from tests.arms import without_masses
from tests.model.arms.weighed import (
    GRAVITY,
    PUBLISHED,
    TOTAL,
    WEIGHED,
    by_mujoco,
    by_pinocchio,
)
from tests.model.arms.witnesses import ELBOW, ELBOW_HOME


def turn(axis, angle):
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def summed_over_links(arm, q):
    """M and the torques that hold the arm, link by link: sum of m Jv'Jv + Jw' I Jw, -m Jv'g."""
    n = len(arm.joints)
    M, torque = np.zeros((n, n)), np.zeros(n)
    origin, rotation = np.zeros(3), np.eye(3)
    axes, origins = [], []
    for joint, angle, link in zip(arm.joints, q, link_inertials(arm), strict=True):
        origin = origin + rotation @ joint.xyz
        for axis, part in zip(np.eye(3)[::-1], joint.rpy[::-1], strict=True):
            rotation = rotation @ turn(axis, part)
        rotation = rotation @ turn(joint.axis, angle)
        axes.append(rotation @ joint.axis / np.linalg.norm(joint.axis))
        origins.append(origin)
        com = origin + rotation @ np.array(link.com)
        linear, angular = np.zeros((3, n)), np.zeros((3, n))
        for i, (axis, place) in enumerate(zip(axes, origins, strict=True)):
            linear[:, i], angular[:, i] = np.cross(axis, com - place), axis
        inertia = rotation @ inertia_matrix(link.inertia) @ rotation.T
        M += link.mass * linear.T @ linear + angular.T @ inertia @ angular
        torque -= link.mass * linear.T @ GRAVITY
    return M, torque


@pytest.mark.parametrize("name", WEIGHED)
@pytest.mark.parametrize("library", [by_mujoco, by_pinocchio])
def test_mass_matrix_and_gravity_are_those_of_an_independent_library(name, library):
    arm, urdf = WEIGHED[name]
    rng = np.random.default_rng(7)
    for _ in range(10):
        q = rng.uniform(-2.0, 2.0, len(arm.joints))
        expected_M, expected_torque = library(urdf, q)
        M, torque = summed_over_links(arm, q)
        # MuJoCo keeps principal inertias, to some 1e-7 of what the file says.
        assert pytest.approx(expected_M, abs=1e-6) == M
        assert torque == pytest.approx(expected_torque, abs=1e-6)


@pytest.mark.parametrize("size", [7, 14])
def test_the_links_weigh_what_the_robot_weighs_without_its_base(size):
    base = float(PUBLISHED[size].split("|")[1])
    moving = sum(link.mass for link in link_inertials(iiwa(size)))
    assert moving + base == pytest.approx(TOTAL[size], abs=1e-6)


def test_a_gripper_counts_as_part_of_the_link_that_carries_it(tmp_path):
    gripper = """
      <link name="finger"><inertial><origin xyz="0 0 0.05" rpy="0.4 0 0"/><mass value="0.7"/>
        <inertia ixx="0.001" iyy="0.002" izz="0.0015" ixy="0.0001" ixz="0" iyz="0"/></inertial>
      </link>
      <joint name="grip" type="prismatic"><parent link="flange"/><child link="finger"/>
        <origin xyz="0.02 0 0.03" rpy="0.1 0.2 0.3"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="0.1" velocity="1" effort="1"/></joint></robot>"""
    path = tmp_path / "arm.urdf"
    path.write_text(ELBOW.read_text().replace("</robot>", gripper))
    arm = read_urdf(path, tip="flange", home=ELBOW_HOME)
    q = np.array([0.4, -0.3, 0.8, 0.2, -0.7, 1.1])
    expected_M, expected_torque = by_pinocchio(path.read_text(), np.array([*q, 0.0]))
    M, torque = summed_over_links(arm, q)
    assert pytest.approx(expected_M[:6, :6], abs=1e-9) == M
    assert torque == pytest.approx(expected_torque[:6], abs=1e-9)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<mass value="4"/>', '<mass value="0"/>'),
        ('ixx="0.01" iyy="0.03" izz="0.03"', 'ixx="0.01" iyy="0.03" izz="0.05"'),
    ],
)
def test_an_arm_with_impossible_masses_moves_but_has_no_twin(tmp_path, old, new):
    path = tmp_path / "arm.urdf"
    path.write_text(ELBOW.read_text().replace(old, new))
    bare, whole = read_urdf(path, home=ELBOW_HOME), read_urdf(ELBOW, home=ELBOW_HOME)
    assert bare.digest == whole.digest
    with pytest.raises(ArmError, match="mass and inertia of every moving link"):
        link_inertials(bare)


def test_joints_without_links_are_named():
    with pytest.raises(ArmError, match=r"A1, .*A7"):
        link_inertials(without_masses(iiwa(7)))
