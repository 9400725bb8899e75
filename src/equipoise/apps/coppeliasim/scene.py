"""The scene in CoppeliaSim: arm, bracket and pendulum, built over the API from the arm's model.

No scene file is needed: base, links, joints, flange and pendulum are created one by one below one
dummy, with all joints at zero. The limits of the joints follow at home: CoppeliaSim moves a joint
into its limits, and those of some arms exclude zero. A joint of CoppeliaSim turns about its z axis.
All joints are kinematic: they are set, and nothing moves or collides by itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from equipoise.apps.coppeliasim.connection import Connection
from equipoise.arrays import Array
from equipoise.errors import OutsideError
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import rotation_from_rpy, turned_to
from equipoise.model.arms.scene import SHORTEST, SIZES, sizes_for


class Scene(NamedTuple):
    """Handles of the objects in CoppeliaSim."""

    joints: tuple[int, ...]
    """Joints of the arm, from the base on."""
    flange: int
    """Dummy at the flange."""
    spindle: int
    """Joint of the pendulum; its position is phi relative to the flange."""


def build_scene(sim: Connection, arm: Arm, root: int) -> Scene:
    """Build arm and pendulum at home.

    Args:
        sim: Connection; its simulation is stopped.
        arm: The arm.
        root: Handle of the dummy below which everything is built.

    Raises:
        OutsideError: CoppeliaSim reports an error.
    """
    sim.call("setObjectAlias", root, "equipoise")
    hand = 2.0 * sizes_for(arm).hand
    base = _transform((0.0, 0.0, -0.01))
    parent = _shape(sim, "base", "cuboid", (0.3, 0.3, 0.02), base, root)  # [m]
    frame, joints = np.eye(4), list[int]()
    steps = [*(joint.xyz for joint in arm.joints[1:]), arm.flange_xyz]
    for number, (joint, step) in enumerate(zip(arm.joints, steps, strict=True), 1):
        frame = frame @ _transform(joint.xyz, rotation_from_rpy(joint.rpy))
        hinge = _joint(sim, f"joint{number}", frame, joint.axis, parent)
        length = float(np.linalg.norm(step))
        kind, size, middle = "spheroid", (hand, hand, hand), np.eye(4)
        if length > SHORTEST:
            kind, size = "cylinder", (hand, hand, length)
            middle = _transform(0.5 * np.array(step), turned_to(np.array(step)))
        parent = _shape(sim, f"link{number}", kind, size, frame @ middle, hinge)
        joints.append(hinge)
    frame = frame @ _transform(arm.flange_xyz, rotation_from_rpy(arm.flange_rpy))
    flange = _add(sim, "Dummy", (0.02,), "flange", frame, parent)
    frame = frame @ _transform(arm.pivot, arm.kinematics(arm.home_free).rotation.T)
    spindle = _joint(sim, "phi", frame, (0.0, 1.0, 0.0), parent)
    sim.call("setJointInterval", spindle, True, (-np.pi, 2.0 * np.pi))
    size = (2.0 * SIZES.rod, 2.0 * SIZES.rod, SIZES.rod_length)
    middle = _transform((0.0, 0.0, 0.5 * SIZES.rod_length))
    _shape(sim, "pendulum", "cylinder", size, frame @ middle, spindle)
    for hinge, joint, q in zip(joints, arm.joints, arm.home, strict=True):
        sim.call("setJointPosition", hinge, q)
        sim.call("setJointInterval", hinge, False, (joint.lower, joint.upper - joint.lower))
    return Scene(tuple(joints), flange, spindle)


def _transform(xyz: Sequence[float] | Array, R: Array | None = None) -> Array:
    """Return the transform of a place and a rotation, shape (4, 4)."""
    T = np.eye(4)
    T[:3, 3] = xyz
    if R is not None:
        T[:3, :3] = R
    return T


def _joint(sim: Connection, alias: str, T: Array, axis: Sequence[float], parent: int) -> int:
    """Create a revolute joint about an axis of the frame T; return its handle."""
    kind, mode = sim.constants.joint_revolute, sim.constants.jointmode_kinematic
    turn = _transform((0.0, 0.0, 0.0), turned_to(np.array(axis)))
    return _add(sim, "Joint", (kind, mode, 0, (0.15, 0.02)), alias, T @ turn, parent)


def _shape(
    sim: Connection, alias: str, kind: str, size: Sequence[float], T: Array, parent: int
) -> int:
    """Create a static primitive shape at T; return its handle."""
    shape = getattr(sim.constants, f"primitiveshape_{kind}")
    handle = _add(sim, "PrimitiveShape", (shape, size, 0), alias, T, parent)
    sim.call("setObjectInt32Param", handle, sim.constants.shapeintparam_respondable, 0)
    sim.call("setObjectInt32Param", handle, sim.constants.shapeintparam_static, 1)
    return handle


def _add(
    sim: Connection, kind: str, args: Sequence[object], alias: str, T: Array, parent: int
) -> int:
    """Create an object below its parent, with which it is removed; return its handle."""
    handle = sim.call(f"create{kind}", *args)
    try:
        sim.call("setObjectParent", handle, parent, True)
    except OutsideError:  # another client removed the parent
        sim.call("removeObjects", [handle])
        raise
    sim.call("setObjectAlias", handle, alias)
    pose = (*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat())
    sim.call("setObjectPose", handle, pose)
    return handle
