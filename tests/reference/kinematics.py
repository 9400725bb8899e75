"""Kinematics of an arm by slow and obvious means: 4x4 matrices, cross products, double loops.

Written from textbook formulas and SciPy's rotations, without the package's chain and compiler: the
held joint is an ordinary joint that happens not to move.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from equipoise.model.arms.arm import Arm


class Flange(NamedTuple):
    position: np.ndarray
    rotation: np.ndarray
    twist: np.ndarray
    bias: np.ndarray
    jacobian: np.ndarray


def transform(rotation, xyz):
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = xyz
    return T


def kinematics(arm: Arm, q, dq) -> Flange:
    """Return the flange's pose, J dq, J_dot dq and J for the free joints `q` and `dq`."""
    q_all, dq_all = list(q), list(dq)
    if arm.held_joint is not None:
        q_all.insert(arm.held_joint - 1, arm.held_angle)
        dq_all.insert(arm.held_joint - 1, 0.0)

    T = np.eye(4)
    z, p = [], []
    for joint, angle in zip(arm.joints, q_all, strict=True):
        T = T @ transform(Rotation.from_euler("xyz", joint.rpy).as_matrix(), joint.xyz)
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        z.append(T[:3, :3] @ axis)
        p.append(T[:3, 3])
        T = T @ transform(Rotation.from_rotvec(angle * axis).as_matrix(), np.zeros(3))
    T = T @ transform(Rotation.from_euler("xyz", arm.flange_rpy).as_matrix(), arm.flange_xyz)
    flange = T[:3, 3]

    n = len(arm.joints)
    J = np.array([np.concatenate([np.cross(z[i], flange - p[i]), z[i]]) for i in range(n)]).T
    # Column i changes as joint k turns: what lies beyond joint k moves with z_k x (...).
    J_dot = np.zeros((6, n))
    for i in range(n):
        for k in range(n):
            z_i_rate = np.cross(z[k], z[i]) if k < i else np.zeros(3)
            p_i_rate = np.cross(z[k], p[i] - p[k]) if k < i else np.zeros(3)
            flange_rate = np.cross(z[k], flange - p[k])
            linear = np.cross(z_i_rate, flange - p[i]) + np.cross(z[i], flange_rate - p_i_rate)
            J_dot[:, i] += dq_all[k] * np.concatenate([linear, z_i_rate])

    free = [i for i in range(n) if i + 1 != arm.held_joint]
    return Flange(flange, T[:3, :3], J @ dq_all, J_dot @ dq_all, J[:, free])
