"""An arm as a value: what it refuses, what its digests see, held joints."""

import math

import numpy as np
import pytest

from equipoise import Arm, iiwa
from equipoise.arm.chain import rotation_from_rpy, rpy_from_rotation
from equipoise.errors import ArmError


def changed(**fields):
    """An iiwa with other fields, checked again."""
    return Arm(**{**{name: getattr(iiwa(7), name) for name in Arm.model_fields}, **fields})


def changed_joint(**fields):
    first, *others = iiwa(7).joints
    return changed(joints=({**first.model_dump(), **fields}, *others))


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: changed(held_joint=None), "7 free joints, expected six; hold one"),
        (lambda: changed(home=(0.0,) * 6), "home has 6 angles; give one for each of 7 joints"),
        (lambda: changed(home=(0, 0, 0, -2.5, 0, 0, 0)), r"joint 4 \(A4\) at -2.5 rad"),
        (lambda: changed(name='a"""; import os'), "name"),
        (lambda: changed_joint(lower=1.0, upper=1.0), "the lower must be below the upper"),
        (lambda: changed_joint(axis=(0.0, 0.0, 0.0)), "axis 0 0 0; give a direction"),
        (
            lambda: changed_joint(xyz=(0.0, 0.0, math.inf)),
            "joint A1: xyz.2: Input should be a finite number",
        ),
    ],
)
def test_an_impossible_arm_is_refused_with_one_sentence(build, says):
    with pytest.raises(ArmError, match=says) as refusal:
        build()
    assert "\n" not in str(refusal.value)


def test_the_digest_sees_geometry_and_limits_but_not_names_masses_home_and_pivot():
    arm = iiwa(7)
    assert arm.digest == changed(name="mine").digest == changed(pivot=(0.1, 0.0, 0.0)).digest
    assert arm.digest == changed(home=(0.1, 0, 0, -1, 0, 0, 0)).digest
    assert arm.digest == changed_joint(link=None).digest
    others = [
        changed(flange_xyz=(0.0, 0.0, 0.1)),
        changed(held_joint=None, joints=arm.joints[:6], home=arm.home[:6]),
        changed(held_angle=0.1, home=(0, 0, 0.1, -1, 0, 0, 0)),
        changed_joint(xyz=(0.0, 0.0, 0.35)),
        changed_joint(axis=(0.0, 1.0, 0.0)),
        changed_joint(velocity=1.0),
        iiwa(14),
    ]
    assert len({arm.digest, *(other.digest for other in others)}) == 8


def test_the_held_joint_is_put_in_and_taken_out():
    arm = changed(held_angle=0.2, home=(0.1, 0, 0.2, -1, 0, 0.5, 0))
    assert arm.with_held([1, 2, 4, 5, 6, 7]).tolist() == [1, 2, 0.2, 4, 5, 6, 7]
    assert arm.without_held((1, 2, 3, 4, 5, 6, 7)) == (1, 2, 4, 5, 6, 7)
    assert [joint.name for joint in arm.free_joints] == ["A1", "A2", "A4", "A5", "A6", "A7"]
    assert np.array_equal(arm.with_held(arm.home_free), arm.home)


@pytest.mark.parametrize("pitch", [0.0, 1.2, math.pi / 2, 1.5707963, -math.pi / 2, 2.9])
@pytest.mark.parametrize("roll", [0.0, 0.7, -2.8])
@pytest.mark.parametrize("yaw", [0.0, -0.4, 3.0])
def test_roll_pitch_and_yaw_come_back_as_the_same_rotation(roll, pitch, yaw):
    R = rotation_from_rpy((roll, pitch, yaw))
    assert rotation_from_rpy(rpy_from_rotation(R)) == pytest.approx(R, abs=1e-14)
