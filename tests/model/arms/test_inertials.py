"""Masses and inertias; `tests/rig/test_twin_physics.py` compares them with other libraries."""

import numpy as np
import pytest

from equipoise.errors import ArmError
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.urdf import read_urdf
from equipoise.worlds.twin.physics import mass_matrix
from tests.arms import without_masses
from tests.model.arms.weighed import PUBLISHED, TOTAL, by_pinocchio
from tests.model.arms.witnesses import ELBOW, ELBOW_HOME


@pytest.mark.parametrize("size", [7, 14])
def test_the_links_weigh_what_the_robot_weighs_without_its_base(size):
    base = float(PUBLISHED[size].split("|")[1])
    moving = sum(link.mass for link in iiwa(size).link_inertials())
    assert moving + base == pytest.approx(TOTAL[size], abs=1e-6)


@pytest.mark.full
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
    q = (0.4, -0.3, 0.8, 0.2, -0.7, 1.1)
    expected, _ = by_pinocchio(path.read_text(), np.array([*q, 0.0]))
    M = mass_matrix(read_urdf(path, tip="flange", home=q))
    assert pytest.approx(expected[:6, :6], abs=1e-6) == M


def test_a_urdf_without_masses_is_refused(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ELBOW.read_text().replace('<mass value="4"/>', '<mass value="0"/>'))
    with pytest.raises(ArmError, match="<inertial>"):
        read_urdf(path, home=ELBOW_HOME)


def test_joints_of_impossible_or_unknown_masses_are_named():
    first, second, *others = iiwa(7).joints
    moments = (0.01, 0.0, 0.0, 0.03, 0.0, 0.05)
    wrong = first.link.model_copy(update={"inertia": moments})
    joints = (first.model_copy(update={"link": wrong}), second, *others)
    for arm, names in (
        (iiwa(7).model_copy(update={"joints": joints}), "joints A1 are"),
        (without_masses(iiwa(7)), "A1, .*A7"),
    ):
        with pytest.raises(ArmError, match=names):
            arm.link_inertials()
