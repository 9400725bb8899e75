"""The iiwas against KUKA's numbers, and the home posture against what is claimed of it."""

import numpy as np
import pytest

from equipoise.arm.iiwa import iiwa
from equipoise.arm.posture import along_x, condition, limit_margin
from equipoise.errors import ArmError
from equipoise.paper import HELD_JOINT, X_LIMIT
from tests.arms import without_masses

# Radians as others print them, to the third decimal.
LIMITS = (2.967, 2.094, 2.967, 2.094, 2.967, 2.094, 3.054)
SPEEDS = {
    7: (1.710, 1.710, 1.745, 2.269, 2.443, 3.142, 3.142),
    14: (1.484, 1.484, 1.745, 1.309, 2.269, 2.356, 2.356),
}
TORQUES = {7: (176, 176, 110, 110, 110, 40, 40), 14: (320, 320, 176, 176, 110, 40, 40)}

TRACK = np.linspace(-X_LIMIT, X_LIMIT, 23)


def shares(arm, q):
    """Return the share of each free joint's velocity that a flange at 1 m/s along x takes."""
    rates = np.linalg.solve(arm.kinematics(q).jacobian, np.eye(6)[0])
    return np.abs(rates) / [joint.velocity for joint in arm.free_joints]


@pytest.mark.parametrize("size", [7, 14])
def test_limits_are_those_of_the_model(size):
    joints = iiwa(size).joints
    assert [joint.upper for joint in joints] == pytest.approx(LIMITS, abs=5e-4)
    assert [joint.lower for joint in joints] == [-joint.upper for joint in joints]
    assert [joint.velocity for joint in joints] == pytest.approx(SPEEDS[size], abs=5e-4)
    assert tuple(joint.torque for joint in joints) == TORQUES[size]
    assert iiwa(size).held_joint == HELD_JOINT


@pytest.mark.parametrize(("size", "height"), [(7, 0.49), (14, 0.53)])
def test_home_points_down_with_outward_along_base_y(size, height):
    arm = iiwa(size)
    position, rotation, *_ = arm.kinematics(arm.home_free)
    assert position[2] == pytest.approx(height, abs=0.005)
    assert rotation[:, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-15)
    pivot = position + rotation @ arm.pivot
    assert pivot - position == pytest.approx([0.0, 0.13, 0.0], abs=1e-15)
    assert position[1] > 0.5  # the base is on the other side


@pytest.mark.parametrize(("size", "speed"), [(7, 1.01), (14, 0.87)])
def test_the_track_is_far_from_singularities_and_limits(size, speed):
    arm = iiwa(size)
    track, home = along_x(arm, TRACK), arm.kinematics(arm.home_free)
    for x, q in zip(TRACK, track, strict=True):
        flange = arm.kinematics(q)
        assert flange.position == pytest.approx(home.position + np.array([x, 0.0, 0.0]), abs=1e-9)
        assert flange.rotation == pytest.approx(home.rotation, abs=1e-9)
    assert max(condition(arm, q) for q in track) <= 11.4
    assert np.degrees(min(limit_margin(arm, q) for q in track)) >= 36.5
    assert 1.0 / max(shares(arm, q).max() for q in track) == pytest.approx(speed, abs=0.01)
    # A1 is the joint that limits the speed at home: x is tangential.
    assert np.argmax(shares(arm, arm.home_free)) == 0


def test_a_place_out_of_reach_is_refused():
    with pytest.raises(ArmError, match="give another home posture"):
        along_x(iiwa(7), [0.0, 0.3, 0.6, 0.9])


def test_another_iiwa_is_refused():
    with pytest.raises(ArmError, match="there is no iiwa 10; choose 7 or 14"):
        iiwa(10)


@pytest.mark.parametrize(("size", "total", "base"), [(7, 23.9, 4.855658), (14, 29.9, 7.050378)])
def test_the_links_weigh_what_the_robot_weighs_without_its_base(size, total, base):
    moving = sum(link.mass for link in iiwa(size).link_inertials())
    assert moving + base == pytest.approx(total, abs=1e-6)


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
