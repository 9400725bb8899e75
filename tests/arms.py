"""Arms that tests change."""

import numpy as np

from equipoise.model.arms.arm import Arm, Inertial, Joint

STEPS = (
    ((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)),
    ((0.08, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 0.35), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 0.1), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, 0.22), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 0.09), (0.0, 0.0, 1.0)),
)
"""Origin and axis of each joint of a small arm."""
HOME = (1.2, 0.4, 1.2, 0.3, 0.9, 0.2)


def without_masses(arm):
    """Return an arm of which no link has a known mass."""
    joints = tuple(joint.model_copy(update={"link": None}) for joint in arm.joints)
    return arm.model_copy(update={"joints": joints})


def with_steps(lengths):
    """Return a small arm, and the same as a URDF, with other lengths [m] of some of its steps."""
    joints, links = [], ['<link name="l0"/>']
    for number, (xyz, axis) in enumerate(STEPS, 1):
        length = lengths.get(number, max(xyz))
        xyz = tuple(length if part else 0.0 for part in xyz)
        link = Inertial.of(f"l{number}", 4.0 / number, np.array([0.0, 0.0, 0.05]), 0.01 * np.eye(3))
        limits = {"lower": -2.9, "upper": 2.9, "velocity": 3.1, "torque": 120.0 / number}
        joints.append(
            Joint(name=f"j{number}", xyz=xyz, axis=axis, acceleration=10.0, link=link, **limits)
        )
        links.append(
            f'<link name="l{number}"><inertial><origin xyz="0 0 0.05"/><mass value="{link.mass}"/>'
            '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>'
            f'<joint name="j{number}" type="revolute"><parent link="l{number - 1}"/>'
            f'<child link="l{number}"/><origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}"/>'
            f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit lower="-2.9" upper="2.9" velocity="3.1" effort="{120.0 / number}"/></joint>'
        )
    hand = lengths.get(7, 0.07)
    links.append(
        '<link name="flange"/><joint name="end" type="fixed"><parent link="l6"/>'
        f'<child link="flange"/><origin xyz="0 0 {hand}"/></joint>'
    )
    pivot = (0.0, lengths.get(8, 0.13), 0.0)
    flange = {"flange_xyz": (0.0, 0.0, hand), "pivot": pivot, "home": HOME}
    arm = Arm(name="small", joints=tuple(joints), **flange)
    return arm, f'<robot name="small">{"".join(links)}</robot>'
