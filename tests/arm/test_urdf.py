"""Arms from URDF files: the same robot by another description, and what is refused."""

import numpy as np
import pytest

from equipoise import iiwa, read_urdf
from equipoise.arm.chain import wrist_centre
from equipoise.arm.posture import along_x, condition
from equipoise.errors import ArmError
from equipoise.paper import X_LIMIT
from equipoise.physics_engine import mujoco
from equipoise.simulation.twin.physics import mass_matrix
from tests.arm.witnesses import DATA, ELBOW, ELBOW_HOME, by_pinocchio


@pytest.fixture
def edited(tmp_path):
    """The test arm's file with one text replaced by another."""

    def write(old="", new=""):
        text = ELBOW.read_text()
        assert old in text
        path = tmp_path / "arm.urdf"
        path.write_text(text.replace(old, new))
        return path

    return write


@pytest.mark.parametrize("size", [7, 14])
def test_a_urdf_of_the_iiwa_is_the_iiwa(size):
    arm = iiwa(size)
    read = read_urdf(DATA / f"iiwa{size}.urdf", held=3, home=arm.home)
    rng = np.random.default_rng(0)
    for _ in range(10):
        q, dq = rng.uniform(-1.5, 1.5, (2, 6))
        for ours, theirs in zip(arm.kinematics(q, dq), read.kinematics(q, dq), strict=True):
            assert ours == pytest.approx(theirs, abs=1e-12)
    assert wrist_centre(read) == pytest.approx(wrist_centre(arm), abs=1e-15)


def test_names_and_limits_are_read():
    arm = read_urdf(ELBOW, home=ELBOW_HOME, acceleration=4.0, pivot=(0.0, 0.1, 0.0))
    assert arm.name == "elbow 6"
    names = ["pan", "shoulder", "elbow", "lift", "slant", "spin"]
    assert [joint.name for joint in arm.joints] == names
    assert [joint.velocity for joint in arm.joints] == [2.5, 2.5, 3.0, 3.5, 3.5, 3.5]
    assert [joint.torque for joint in arm.joints] == [150, 150, 100, 30, 30, 30]
    assert {joint.acceleration for joint in arm.joints} == {4.0}
    assert (arm.joints[1].lower, arm.joints[1].upper) == (-2.2, 2.2)
    assert arm.joints[3].upper == 20.0 * np.pi  # continuous: no limit to speak of
    assert arm.pivot == (0.0, 0.1, 0.0)


def test_a_home_is_searched_where_none_is_given():
    arm = read_urdf(ELBOW)
    assert arm.kinematics(arm.home_free).position[2] > 0.3
    track = along_x(arm, np.linspace(-X_LIMIT, X_LIMIT, 23))
    assert max(condition(arm, q) for q in track) < 20.0
    # The pivot is beside the flange along base y, away from the base.
    flange = arm.kinematics(arm.home_free)
    side = np.sign(flange.position[1])
    assert flange.rotation @ arm.pivot == pytest.approx([0.0, side * 0.13, 0.0], abs=1e-12)


def test_a_name_is_made_harmless(edited):
    path = edited('robot name="elbow 6"', 'robot name="a&quot;&quot;&quot;\\n; b"')
    assert read_urdf(path, home=ELBOW_HOME).name == "a____n_ b"


@pytest.mark.parametrize("limit", ['lower="0" upper="0"', 'lower="1" upper="-1"', 'lower="wide"'])
def test_a_continuous_joint_has_no_position_limits_whatever_the_file_says(edited, limit):
    limits = f'<limit {limit} velocity="2" effort="9"/>'
    path = edited('<limit velocity="3.5" effort="30"/>', limits)
    lift = read_urdf(path, home=ELBOW_HOME).joints[3]
    assert (lift.lower, lift.upper) == (-20.0 * np.pi, 20.0 * np.pi)
    assert (lift.velocity, lift.torque) == (2.0, 9.0)


INERTIAL = (
    '<link name="{}"><inertial><origin xyz="0 0 0.1"/><mass value="{}"/>'
    '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)


@pytest.mark.parametrize("link", ["floor", "pedestal", "flange"])
@pytest.mark.parametrize(
    ("mass", "moments"),
    [(0.5, (1, 0, 0)), (0.5, (-1, -1, -1)), (1e-7, (3e-22, 3e-22, 5e-22)), (0.0, (1, 1, 1))],
)
def test_an_impossible_inertia_of_a_fixed_link_counts_as_a_point_mass(edited, link, mass, moments):
    old = f'<link name="{link}"/>'
    dummy = read_urdf(edited(old, INERTIAL.format(link, mass, *moments)), home=ELBOW_HOME)
    point = read_urdf(edited(old, INERTIAL.format(link, mass, 0, 0, 0)), home=ELBOW_HOME)
    assert dummy == point
    assert dummy.joints[5].link.mass == pytest.approx(0.7 + (mass if link == "flange" else 0.0))


@pytest.mark.full
def test_a_gripper_counts_as_part_of_the_link_that_carries_it(edited):
    gripper = """
      <link name="finger"><inertial><origin xyz="0 0 0.05" rpy="0.4 0 0"/><mass value="0.7"/>
        <inertia ixx="0.001" iyy="0.002" izz="0.0015" ixy="0.0001" ixz="0" iyz="0"/></inertial>
      </link>
      <joint name="grip" type="prismatic"><parent link="flange"/><child link="finger"/>
        <origin xyz="0.02 0 0.03" rpy="0.1 0.2 0.3"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="0.1" velocity="1" effort="1"/></joint></robot>"""
    path = edited("</robot>", gripper)
    q = (0.4, -0.3, 0.8, 0.2, -0.7, 1.1)
    expected, _ = by_pinocchio(path.read_text(), np.array([*q, 0.0]))
    M = mass_matrix(read_urdf(path, tip="flange", home=q))
    assert pytest.approx(expected[:6, :6], abs=1e-6) == M


def test_drawings_of_a_link_are_not_judged(edited, capfd):
    drawing = '<visual name="a"><geometry><box size="1 1 1"/></geometry>{}</visual>'
    drawings = drawing.format('<material name="m"/><material name="n"/>') + drawing.format("")
    path = edited('<link name="flange"/>', f'<link name="flange">{drawings}</link>')
    assert read_urdf(path, home=ELBOW_HOME) == read_urdf(ELBOW, home=ELBOW_HOME)
    assert capfd.readouterr() == ("", "")


def test_warnings_of_mujoco_are_neither_printed_nor_written(tmp_path, capfd):
    ball = '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    model = mujoco().MjModel.from_xml_string(ball)
    data = mujoco().MjData(model)
    data.qpos[0] = np.nan
    mujoco().mj_step(model, data)
    assert data.warning.number.sum() == 1
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_the_remedy_for_a_wrong_number_of_joints_fits_the_number(edited):
    five = edited('"lift" type="continuous"', '"lift" type="fixed"')
    with pytest.raises(ArmError, match="5 free joints, expected six; choose another tip or arm"):
        read_urdf(five, home=ELBOW_HOME)
    with pytest.raises(ArmError, match="5 free joints, expected six; leave out held"):
        read_urdf(ELBOW, held=2)
    # The joint to hold needs no limits before it is held.
    seven = edited('<joint name="plate" type="fixed">', '<joint name="plate" type="revolute">')
    with pytest.raises(ArmError, match="7 free joints, expected six; hold one with held"):
        read_urdf(seven)
    with pytest.raises(ArmError, match="held joint is 9; give a number from 1 to 6"):
        read_urdf(ELBOW, held=9)


def test_a_joint_is_held_where_home_has_it():
    home = (0.1, 0.2, 0.3, -1.0, 0.3, 0.4, 0.5)
    arm = read_urdf(DATA / "iiwa7.urdf", held=3, home=home)
    assert (arm.held_angle, arm.home) == (0.3, home)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("</robot>", "", None),
        ('type="continuous"', 'type="prismatic"', None),
        ('lower="-3.1"', 'lower="wide"', None),
        ('upper="3.1"', 'upper="-4"', None),
        ('axis xyz="0 2 0"', 'axis xyz="0 0 0"', None),
        ('<parent link="wrist_2"/>', "", None),
        ('<child link="flange"/>', '<child link="adapter"/>', None),
        ('<link name="flange"/>', '<link name="flange"/><link name="x"/>', None),
        ('<mass value="4"/>', '<mass value="0"/>', "<inertial>"),
        # Not taken as missing.
        ('<origin xyz="0 0 0.05"/>', '<origin xyz="nan 0 0.05"/>', "<origin> contains NaN"),
        ('<origin xyz="0 0 0.05"/>', '<origin xyz="-NaN 0 0.05"/>', "<origin> contains NaN"),
        # The name of the pendulum's own joint.
        ('name="slant"', 'name="phi"', "or one is phi: .*phi, spin"),
    ],
)
def test_other_files_are_refused(edited, old, new, says):
    with pytest.raises(ArmError, match=says):
        read_urdf(edited(old, new), home=ELBOW_HOME)


def test_two_ends_are_a_question(edited):
    camera = (
        '<link name="camera"/><joint name="mount" type="fixed"><parent link="wrist_3"/>'
        '<child link="camera"/></joint></robot>'
    )
    path = edited("</robot>", camera)
    with pytest.raises(ArmError, match="flange, camera"):
        read_urdf(path, home=ELBOW_HOME)
    assert read_urdf(path, tip="flange", home=ELBOW_HOME) == read_urdf(ELBOW, home=ELBOW_HOME)
    with pytest.raises(ArmError, match="flange, camera"):
        read_urdf(path, tip="hand", home=ELBOW_HOME)
