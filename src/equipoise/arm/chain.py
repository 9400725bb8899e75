"""Constants of a chain of joints: rotations and translations from one axis to the next.

A held joint is folded into the constants, and each frame is turned so that its joint rotates about
the frame's own z axis. The result is six free joints of one kind and seven constant steps.
"""

from math import nan
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from equipoise.arrays import Array

if TYPE_CHECKING:
    from equipoise.arm.arm import Arm

Triple = tuple[float, float, float]

FREE_JOINTS: Final = 6
"""Number of joints that move."""


class Link(NamedTuple):
    """A constant step of the chain, from one free joint's turned frame to the next frame."""

    rotation: Array
    """Axes of the next frame in this one, shape (3, 3)."""
    translation: Array
    """Origin of the next frame in this one [m], shape (3,)."""


def links(arm: "Arm") -> tuple[Link, ...]:
    """Return the constants of an arm: a step to each free joint and one to the flange."""
    chain: list[Link] = []
    rotation, offset = np.eye(3), np.zeros(3)  # since the last free joint
    for number, joint in enumerate(arm.joints, start=1):
        offset = offset + rotation @ joint.xyz
        rotation = rotation @ rotation_from_rpy(joint.rpy)
        if number == arm.held_joint:
            rotation = rotation @ rotation_about(np.array(joint.axis), arm.held_angle)
        else:
            along_z = turned_to(np.array(joint.axis))
            chain.append(Link(_exact(rotation @ along_z), offset))
            rotation, offset = along_z.T, np.zeros(3)
    offset = offset + rotation @ arm.flange_xyz
    return (*chain, Link(_exact(rotation @ rotation_from_rpy(arm.flange_rpy)), offset))


def rotation_about(axis: Array, angle: float) -> Array:
    """Return the rotation by `angle` [rad] about `axis`, shape (3, 3)."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return _exact(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def rotation_from_rpy(rpy: Triple) -> Array:
    """Return the rotation by roll, pitch and yaw [rad] about fixed axes, shape (3, 3)."""
    x, y, z = (rotation_about(axis, angle) for axis, angle in zip(np.eye(3), rpy, strict=True))
    return _exact(z @ y @ x)


def rpy_from_rotation(R: Array) -> Triple:
    """Return roll, pitch and yaw [rad] of a rotation.

    Roll is read after yaw is undone. The three together are then exact near a pitch of 90 degrees
    too, where roll and yaw alone are not.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    level = rotation_about(np.eye(3)[2], -yaw) @ R
    pitch = np.arctan2(-level[2, 0], level[0, 0])
    roll = np.arctan2(-level[1, 2], level[1, 1])
    return float(roll), float(pitch), float(yaw)


def _exact(R: Array) -> Array:
    """Return `R` with entries within 1e-15 of -1, 0 or 1 rounded to that number."""
    return np.where(np.abs(R - np.round(R)) < 1e-15, np.round(R) + 0.0, R)


def turned_to(axis: Array) -> Array:
    """Return the smallest rotation that takes z to `axis`."""
    x, y, z = axis / np.linalg.norm(axis)
    across = np.array([-y, x, 0.0])  # z cross axis
    # The norm of subnormal numbers underflows to zero.
    there = np.linalg.norm(across) > 0.0
    return rotation_about(across if there else np.eye(3)[0], np.arctan2(np.hypot(x, y), z))


def wrist_centre(arm: "Arm") -> Triple:
    """Return the point in which the last three axes meet, in the flange frame [m]; NaN without one.

    Axes that meet in one posture meet in all: the point lies on the fifth and on the sixth axis,
    and neither rotation moves it. A distance below 1e-12 m counts as meeting.
    """
    rotation, origin = np.eye(3), np.zeros(3)  # in the frame of the fourth axis
    axes, origins = [rotation[:, 2]], [origin]
    for step in links(arm)[4:]:
        origin = origin + rotation @ step.translation
        rotation = rotation @ step.rotation
        axes.append(rotation[:, 2])
        origins.append(origin)
    across = [np.eye(3) - np.outer(axis, axis) for axis in axes[:3]]
    offsets = [P @ origin for P, origin in zip(across, origins[:3], strict=True)]
    point = np.linalg.lstsq(np.vstack(across), np.concatenate(offsets))[0]
    missed = [np.linalg.norm(P @ point - o) for P, o in zip(across, offsets, strict=True)]
    x, y, z = (rotation.T @ (point - origin)).tolist()
    return (x, y, z) if max(missed) < 1e-12 else (nan, nan, nan)
