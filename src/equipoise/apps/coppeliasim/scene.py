"""The scene in CoppeliaSim: arm, bracket and pendulum, built over the API from the arm's model.

No scene file is needed: base, links, joints with their limits, flange and pendulum are created one
by one, in the posture with all joints at zero, below an object with the alias `equipoise`. A joint
of CoppeliaSim turns about its z axis. Nothing collides.

With a physics engine each link is a dynamic shape between two joints, with the inertial of the
twin; the bracket is part of the last link. The joints are CoppeliaSim's position controllers. In
its source a controller commands the velocity P e / 0.005 s for an error e, within the joint's
limits of velocity and torque: a first-order lag of 0.005 s / P.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from equipoise.apps.coppeliasim.address import MUJOCO, Address
from equipoise.apps.coppeliasim.connection import Connection
from equipoise.model.arms.arm import Arm, Inertial
from equipoise.model.arms.chain import Floats, rotation_from_rpy, turned_to
from equipoise.model.arms.inertials import inertia_entries, inertia_matrix, link_inertials
from equipoise.model.arms.scene import SIZES, Sizes, sizes_for
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings, rotor_inertias
from equipoise.settings import GRAVITY
from equipoise.worlds.twin.physics import bar_inertial, pivot, rod_inertial

ALIAS: Final = "equipoise"
"""Alias of the base of the arm: the root of everything that is built."""
TILE: Final = (0.3, 0.3, 0.02)
"""Sizes of the base [m]."""
GAIN_PERIOD: Final = 0.005
"""Time that divides the gain of a position controller, in CoppeliaSim's source [s]."""
HAND_TORQUE: Final = 100.0
"""Torque with which the pendulum is led to its release [N m]; its weight needs 0.2."""


def _at(xyz: Sequence[float] | Floats, R: Floats | None = None) -> Floats:
    """Return the transform of a place and a rotation, shape (4, 4)."""
    T = np.eye(4)
    T[:3, 3] = xyz
    if R is not None:
        T[:3, :3] = R
    return T


def _inverse(T: Floats) -> Floats:
    """Return the inverse of a transform, shape (4, 4)."""
    return np.asarray(np.linalg.inv(T), np.float64)


MIDDLE: Final = _at((0.0, 0.0, 0.5 * SIZES.rod_length))
"""Middle of the drawn pendulum in the frame of its pivot."""


class Scene(NamedTuple):
    """Handles of the objects in CoppeliaSim."""

    base: int
    """Root of the arm."""
    joints: tuple[int, ...]
    """Joints of the arm, from the base on."""
    flange: int
    """Dummy at the flange."""
    spindle: int
    """Joint of the pendulum; its position is phi relative to the flange."""
    rod: int
    """Pendulum; its z axis points away from the pivot."""


def build_scene(sim: Connection, arm: Arm, address: Address, pendulum: PendulumParameters) -> Scene:
    """Build arm and pendulum at home, after removal of those of an earlier run.

    Args:
        sim: Connection; its simulation is stopped.
        arm: The arm.
        address: Engine and numbers.
        pendulum: Nominal parameters.

    Raises:
        ArmError: With an engine: the masses of the arm's links are not known.
        OutsideError: CoppeliaSim reports an error.
    """
    numbers = address.numbers
    dynamic = numbers is not None
    inertials: Sequence[Inertial | None] = [None] * len(arm.joints)
    if numbers is not None:
        arm = arm.model_copy(update={"pivot": pivot(arm, numbers.pivot_outward)})
        inertials = _with_bracket(arm, numbers.bracket_mass)
    remove_scene(sim)
    sizes = sizes_for(arm)
    low = _at((0.0, 0.0, -0.5 * TILE[2]))
    base = _shape(sim, ALIAS, "cuboid", TILE, low, -1, None)
    frame, steps = np.eye(4), [joint.xyz for joint in arm.joints] + [arm.flange_xyz]
    parent, joints = base, list[int]()
    for number, (joint, inertial) in enumerate(zip(arm.joints, inertials, strict=True), 1):
        frame = frame @ _at(joint.xyz, rotation_from_rpy(joint.rpy))
        hinge = _joint(sim, f"joint{number}", frame, joint.axis, parent, dynamic)
        sim.call("setJointInterval", hinge, False, (joint.lower, joint.upper - joint.lower))
        parent = _link(sim, number, frame, np.array(steps[number]), sizes, hinge, inertial)
        joints.append(hinge)
    frame = frame @ _at(arm.flange_xyz, rotation_from_rpy(arm.flange_rpy))
    flange = sim.call("createDummy", 0.02)
    _place(sim, flange, "flange", frame, parent)
    frame = frame @ _at(arm.pivot, arm.pose(arm.home_free).rotation.T)
    spindle = _joint(sim, "phi", frame, (0.0, 1.0, 0.0), parent, dynamic)
    sim.call("setJointInterval", spindle, True, (-np.pi, 2.0 * np.pi))
    thickness = (2.0 * SIZES.rod, 2.0 * SIZES.rod, SIZES.rod_length)
    rod = _shape(sim, "pendulum", "cylinder", thickness, frame @ MIDDLE, spindle, None)
    scene = Scene(base, tuple(joints), flange, spindle, rod)
    if numbers is not None:
        _set_drives(sim, scene, arm, address.engine, numbers)
        set_pendulum(sim, scene, address, pendulum)
    for hinge, q in zip(joints, arm.home, strict=True):
        sim.call("setJointPosition", hinge, q)
    return scene


def remove_scene(sim: Connection) -> None:
    """Remove everything below the alias `equipoise`, if there is any."""
    base = find_scene(sim)
    if base >= 0:
        sim.call("removeObjects", sim.call("getObjectsInTree", base))


def find_scene(sim: Connection) -> int:
    """Return the handle of the base of an earlier scene, -1 without one."""
    return sim.call("getObject", f"/{ALIAS}", {"noError": True})


def set_pendulum(
    sim: Connection, scene: Scene, address: Address, pendulum: PendulumParameters
) -> None:
    """Set the inertia and the frictions of the pendulum, while the simulation is stopped.

    Viscous and dry friction exist in the engine MuJoCo alone; the drag of air in none.

    Args:
        sim: Connection.
        scene: Handles.
        address: Engine and numbers.
        pendulum: The pendulum of a trial.
    """
    if address.numbers is None:
        return
    inertial = rod_inertial(pendulum.w2, address.numbers.pendulum_mass)
    _weigh(sim, scene.rod, inertial, _inverse(MIDDLE))
    if address.engine == MUJOCO:
        I = inertial.mass * GRAVITY * inertial.com[2] / pendulum.w2
        frictions = {"damping": pendulum.c * I, "frictionloss": pendulum.coulomb * I}
        for name, value in frictions.items():
            parameter = sim.constant(f"mujoco_joint_{name}")
            sim.call("setEngineFloatParam", parameter, scene.spindle, value)


def _set_drives(
    sim: Connection, scene: Scene, arm: Arm, engine: str | None, numbers: TwinSettings
) -> None:
    """Set the controllers of the arm's joints, and the hand that leads the pendulum."""
    mode, rotors = sim.constant("jointintparam_dynctrlmode"), rotor_inertias(numbers, len(arm.home))
    fastest, gain = sim.constant("jointfloatparam_maxvel"), f"{engine}_joint_pospid1"
    for hinge, joint, rotor in zip(scene.joints, arm.joints, rotors, strict=True):
        sim.call("setObjectInt32Param", hinge, mode, sim.constant("jointdynctrl_position"))
        sim.call("setObjectFloatParam", hinge, fastest, joint.velocity)
        sim.call("setJointTargetForce", hinge, joint.torque, False)
        P = GAIN_PERIOD / numbers.lag
        sim.call("setEngineFloatParam", sim.constant(gain), hinge, P)
        if engine == MUJOCO:
            armature = sim.constant("mujoco_joint_armature")
            sim.call("setEngineFloatParam", armature, hinge, rotor)
    sim.call("setObjectInt32Param", scene.spindle, mode, sim.constant("jointdynctrl_velocity"))
    sim.call("setObjectFloatParam", scene.spindle, fastest, 100.0)
    if engine == MUJOCO:
        sim.call("setEngineFloatParam", sim.constant("mujoco_joint_armature"), scene.spindle, 0.0)


def _with_bracket(arm: Arm, mass: float) -> list[Inertial]:
    """Return the inertials of the links, the bracket as a part of the last one."""
    *links, last = link_inertials(arm)
    if mass == 0.0:
        return [*links, last]
    bar, R = bar_inertial(mass, np.array(arm.pivot)), rotation_from_rpy(arm.flange_rpy)
    com = np.array(arm.flange_xyz) + R @ bar.com
    parts = (
        (last.mass, np.array(last.com), inertia_matrix(last.inertia)),
        (bar.mass, com, R @ inertia_matrix(bar.inertia) @ R.T),
    )
    m = sum(part[0] for part in parts)
    centre = sum((part[0] * part[1] for part in parts), np.zeros(3)) / m
    arms = [(own, inertia, at - centre) for own, at, inertia in parts]
    moved = [I + own * (r @ r * np.eye(3) - np.outer(r, r)) for own, I, r in arms]
    x, y, z = centre.tolist()
    both = Inertial(
        name=last.name, mass=m, com=(x, y, z), inertia=inertia_entries(moved[0] + moved[1])
    )
    return [*links, both]


def _joint(
    sim: Connection, alias: str, T: Floats, axis: Sequence[float], parent: int, dynamic: bool
) -> int:
    """Create a revolute joint about an axis of the frame T; return its handle."""
    mode = sim.constant("jointmode_dynamic" if dynamic else "jointmode_kinematic")
    handle = sim.call("createJoint", sim.constant("joint_revolute"), mode, 0, (0.15, 0.02))
    _place(sim, handle, alias, T @ _at((0.0, 0.0, 0.0), turned_to(np.array(axis))), parent)
    return handle


def _link(
    sim: Connection,
    number: int,
    T: Floats,
    step: Floats,
    sizes: Sizes,
    parent: int,
    inertial: Inertial | None,
) -> int:
    """Create the link from frame T along a step; return its handle."""
    length = float(np.linalg.norm(step))
    if length > 0.0:
        kind, size = "cylinder", (2.0 * sizes.hand, 2.0 * sizes.hand, length)
        own = _at(0.5 * step, turned_to(step))
    else:
        kind, size, own = "spheroid", (2.0 * sizes.hand,) * 3, np.eye(4)
    return _shape(sim, f"link{number}", kind, size, T @ own, parent, inertial, _inverse(own))


def _shape(
    sim: Connection,
    alias: str,
    kind: str,
    size: Sequence[float],
    T: Floats,
    parent: int,
    inertial: Inertial | None,
    from_frame: Floats | None = None,
) -> int:
    """Create a primitive shape at T; return its handle. One without an inertial is static."""
    shape = sim.constant(f"primitiveshape_{kind}")
    handle = sim.call("createPrimitiveShape", shape, size, 0)
    _place(sim, handle, alias, T, parent)
    sim.call("setObjectInt32Param", handle, sim.constant("shapeintparam_respondable"), 0)
    sim.call("setObjectInt32Param", handle, sim.constant("shapeintparam_static"), 1)
    if inertial is not None and from_frame is not None:
        _weigh(sim, handle, inertial, from_frame)
    return handle


def _weigh(sim: Connection, handle: int, inertial: Inertial, from_frame: Floats) -> None:
    """Make a shape dynamic, with an inertial in a frame; `from_frame` maps it into the shape's."""
    com = (from_frame @ _at(inertial.com))[:3].ravel()
    sim.call("setObjectInt32Param", handle, sim.constant("shapeintparam_static"), 0)
    sim.call("setShapeMass", handle, inertial.mass)
    sim.call("setShapeInertia", handle, inertia_matrix(inertial.inertia).ravel(), com)


def _place(sim: Connection, handle: int, alias: str, T: Floats, parent: int) -> None:
    """Attach a new object to its parent, with which it is removed; name it, and place it."""
    if parent >= 0:
        sim.call("setObjectParent", handle, parent, True)
    sim.call("setObjectAlias", handle, alias)
    x, y, z = T[:3, 3]
    pose = (x, y, z, *Rotation.from_matrix(T[:3, :3]).as_quat())
    sim.call("setObjectPose", handle, pose)
