"""MuJoCo model of an arm, its pendulum and the table, in simple geometry on the thick side.

A link is a capsule from joint to joint, as wide as its widest place, and shortened at its ends; two
joints in one place have no link between them. A joint that turns across its links has a housing, a
capsule along its axis. The sizes are our own reading of public models of the iiwa; those of a
shorter arm are smaller in proportion (`sizes_for`). Connectors and cables are not drawn. The
pendulum sits on a bracket from the flange and turns about base y: its joint angle is phi, zero
upright, positive towards +x. MuJoCo is imported where it is used.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arm.chain import rotation_from_rpy
from equipoise.arrays import Array
from equipoise.physics_engine import mujoco


class Sizes(NamedTuple):
    """Thickness of the parts; the defaults are for the iiwas."""

    link: float = 0.11
    """Radius of a link [m]."""
    pulled_in: float = 0.03
    """Distance from the end of a link's capsule to its joints [m]; less on a short link."""
    housing: float = 0.09
    """Radius of the housing of a joint that turns across its links [m]."""
    housing_reach: float = 0.05
    """Distance from the centre of a housing to the centre of its round end [m]."""
    hand: float = 0.07
    """Radius of the last link, which ends in the flange [m]."""
    bracket: float = 0.015
    """Radius of the bracket that carries the pendulum [m]."""
    rod: float = 0.01
    """Radius of the pendulum [m]."""
    rod_length: float = 0.21
    """Length of the pendulum [m]: a uniform rod with the paper's period of 0.75 s."""


SIZES: Final = Sizes()
"""Thickness of the parts of an iiwa, on the thick side."""
SHORTEST: Final = 1e-3
"""Length of the shortest step that is drawn [m]; rounding in a file is shorter, and has no
direction."""


def sizes_for(arm: Arm, sizes: Sizes = SIZES) -> Sizes:
    """Return sizes in proportion to the length of an arm; from 1.2 m on, those given.

    The stretched iiwa 7 has 1.27 m.

    Args:
        arm: The arm.
        sizes: Thickness of the parts of an iiwa.
    """
    steps = [joint.xyz for joint in arm.joints] + [arm.flange_xyz]
    fraction = min(1.0, float(sum(np.linalg.norm(step) for step in steps)) / 1.2)
    scaled = ("link", "pulled_in", "housing", "housing_reach", "hand")
    return sizes._replace(**{name: fraction * getattr(sizes, name) for name in scaled})


def scene(arm: Arm, sizes: Sizes = SIZES) -> Any:
    """Return a MuJoCo model of the rig: every joint of the arm, then the pendulum.

    Its keyframe `home` has the arm at home and the pendulum hanging. Nothing collides, and the
    masses are those of the drawing, not of the robot.

    Args:
        arm: The arm.
        sizes: Thickness of the parts of an iiwa; for a shorter arm, they are scaled.

    Returns:
        A `mujoco.MjSpec`.
    """
    mj, sizes = mujoco(), sizes_for(arm, sizes)
    spec = mj.MjSpec()
    spec.modelname = arm.name
    spec.compiler.degree = False
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6  # of frames without geometry

    def geom(body: Any, name: str, shape: Any, **place: Any) -> None:
        body.add_geom(name=name, type=shape, contype=0, conaffinity=0, **place)

    def capsule(body: Any, name: str, start: Array, end: Array, radius: float) -> None:
        ends = np.concatenate([start, end])
        geom(body, name, mj.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[radius, 0.0, 0.0])

    def child(body: Any, name: str, xyz: Any, rotation: Array) -> Any:
        quaternion = np.zeros(4)
        mj.mju_mat2Quat(quaternion, rotation.ravel())
        return body.add_body(name=name, pos=xyz, quat=quaternion)

    body, size, place = spec.worldbody, [1.5, 1.5, 0.05], [0.0, 0.0, -0.05]
    geom(body, "table", mj.mjtGeom.mjGEOM_BOX, size=size, pos=place)
    steps = [np.array(joint.xyz) for joint in arm.joints] + [np.array(arm.flange_xyz)]
    lengths = [float(np.linalg.norm(step)) for step in steps]
    links = [number for number, length in enumerate(lengths) if length > SHORTEST]
    across = _across(arm, steps, links)
    for number, step in enumerate(steps):
        if number in links:
            radius = sizes.hand if number == links[-1] else sizes.link
            inset = step * min(sizes.pulled_in / lengths[number], 0.4)
            capsule(body, f"link {number}", inset, step - inset, radius)
        if number < len(arm.joints):
            joint = arm.joints[number]
            body = child(body, f"frame {number + 1}", step, rotation_from_rpy(joint.rpy))
            hinge = mj.mjtJoint.mjJNT_HINGE
            limits = [joint.lower, joint.upper]
            body.add_joint(name=joint.name, type=hinge, axis=joint.axis, range=limits)
            if across[number]:
                reach = sizes.housing_reach * np.array(joint.axis) / np.linalg.norm(joint.axis)
                capsule(body, f"housing {number + 1}", -reach, reach, sizes.housing)

    flange = child(body, "flange", steps[-1], rotation_from_rpy(arm.flange_rpy))
    pivot = np.array(arm.pivot)
    if np.linalg.norm(pivot) > SHORTEST:
        capsule(flange, "bracket", np.zeros(3), pivot, sizes.bracket)
    pendulum = child(flange, "pendulum", pivot, arm.kinematics(arm.home_free).rotation.T)
    pendulum.add_joint(name="phi", type=mj.mjtJoint.mjJNT_HINGE, axis=[0.0, 1.0, 0.0])
    top = np.array([0.0, 0.0, sizes.rod_length])
    capsule(pendulum, "rod", np.zeros(3), top, sizes.rod)
    spec.add_key(name="home", qpos=[*arm.home, np.pi])
    return spec


def _across(arm: Arm, steps: list[Array], links: list[int]) -> list[bool]:
    """Return for each joint whether it turns across the links that it joins, not along one."""
    rotation, axes, directions = np.eye(3), list[Array](), list[Array]()
    for joint, step in zip(arm.joints, steps, strict=False):
        directions.append(rotation @ step)
        rotation = rotation @ rotation_from_rpy(joint.rpy)
        axes.append(rotation @ joint.axis / np.linalg.norm(joint.axis))
    directions.append(rotation @ steps[-1])
    along = {number: directions[number] / np.linalg.norm(steps[number]) for number in links}
    result: list[bool] = []
    for number, axis in enumerate(axes):
        before = [place for place in links if place <= number][-1:]
        after = [place for place in links if place > number][:1]
        result.append(all(abs(axis @ along[place]) < 0.9 for place in before + after))
    return result
