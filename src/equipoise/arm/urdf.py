"""Arms by name or file, for the command line, `rig.toml` and studies.

A package registers an arm under the entry point group `equipoise.arms`: its name, and a function
without arguments that returns an `Arm`. The iiwas are registered in the same way. A URDF gives the
chain of revolute joints between two links, with its masses.

MuJoCo reads a URDF. Fixed joints become part of the next origin (or of the flange). Everything
that a moving link carries outside the chain (fixed links, tools, grippers at zero) is merged into
its mass and inertia; where its own inertia is impossible, as a point mass. URDF holds no limits of
accelerations, no home and no pendulum: these are arguments. Every moving link of the chain needs
its mass and inertia.
"""

import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from math import copysign, pi
from pathlib import Path
from typing import Any, Final

import numpy as np

from equipoise.arguments import checked
from equipoise.arm.arm import ROUNDING, Arm, Inertial, Joint, check_free
from equipoise.arm.chain import Triple, rpy_from_rotation
from equipoise.arm.iiwa import ACCELERATION, PIVOT_OUTWARD
from equipoise.arm.posture import search_home
from equipoise.arrays import Array
from equipoise.entry_points import how_to_install, registered
from equipoise.errors import ArmError
from equipoise.files import MEBIBYTE, StrPath, quoted, read_text, shortened
from equipoise.physics_engine import mujoco

SUFFIXES: Final = (".urdf", ".xml")
"""File suffixes of URDFs."""
CONTINUOUS: Final = 20.0 * pi
"""Largest position limit of a joint, that of a continuous one: ten turns each way [rad]."""


def read_arm(
    source: Arm | StrPath | None,
    *,
    home: Sequence[float] | None = None,
    pivot: Triple | None = None,
    **urdf: Any,
) -> Arm:
    """Return an arm itself, or the arm of a registered name or of a URDF file.

    Args:
        source: The arm, its registered name, or the path of a URDF; by default the iiwa7.
        home: Posture at x = 0, all joints [rad]; by default the arm's own, or a search.
        pivot: The pendulum's pivot in the flange frame [m]; by default the arm's own.
        urdf: Other arguments of `read_urdf`; None stands for the default.

    Raises:
        ArmError: The arm is unknown, or an argument does not fit it.
    """
    if isinstance(source, Arm):
        return source
    name = "iiwa7" if source is None else str(source)
    options = {key: value for key, value in urdf.items() if value is not None}
    if Path(name).suffix.lower() in SUFFIXES:
        return read_urdf(name, home=home, pivot=pivot, **options)
    arms = registered("equipoise.arms")
    if name not in arms:
        known = f"choose {', '.join(sorted(arms))} or a file that ends in .urdf"
        raise ArmError(f"there is no arm {quoted(name)}; {how_to_install(name) or known}")
    if options:
        raise ArmError(
            f"{' and '.join(options)} belong to an arm from a URDF, and {name} is a registered arm;"
            " leave them out"
        )
    arm = arms[name].load()()
    if not isinstance(arm, Arm):
        kind = type(arm).__name__
        raise ArmError(f"{arms[name].value} returns a {kind}, expected an equipoise.Arm")
    fields = dict(arm)
    fields |= {} if home is None else {"home": tuple(home)}
    fields |= {} if pivot is None else {"pivot": pivot}
    return Arm(**fields)


@checked
def read_urdf(
    path: StrPath,
    *,
    tip: str | None = None,
    held: int | None = None,
    held_angle: float | None = None,
    home: Sequence[float] | None = None,
    pivot: Triple | None = None,
    acceleration: float = ACCELERATION,
) -> Arm:
    """Read an arm from a URDF file, whose root is the fixed link, z up.

    Args:
        path: The file.
        tip: Link of the flange; by default the only end of the tree.
        held: Joint that does not move, counted from one along the chain.
        held_angle: Its angle [rad]; by default that in `home`, or zero without a home.
        home: Posture at x = 0, all joints [rad]; by default the result of `search_home`.
        pivot: The pendulum's pivot in the flange frame [m]; by default beside the flange, along
            the spindle at home and away from the base.
        acceleration: Acceleration limit of every joint [rad/s^2].

    Raises:
        ArmError: The file is no URDF, or its chain is not an arm with six free joints.
    """
    path = Path(path)
    text = read_text(path, 2 * MEBIBYTE, "a URDF", ArmError)  # humanoids with hands need half
    try:
        robot = ElementTree.fromstring(text)
        if robot.tag != "robot":
            raise ValueError(f"it begins with <{robot.tag}>, expected <robot>")
        for element in robot.iter():  # MuJoCo would take NaN as missing
            if any(re.search(r"(?i)(^|\s)[+-]?nan($|\s)", v) for v in element.attrib.values()):
                raise ValueError(f"<{element.tag}> contains NaN instead of a number")
        # MuJoCo would print warnings about these elements, or fail.
        text = re.sub(r"(</?)(visual|collision|limit|mimic)\b", r"\1unused", text)
        spec = mujoco().MjSpec.from_string(text)
    except Exception as error:  # of parsers and codecs
        raise ArmError(
            f"{path} is not a URDF ({shortened(str(error), 200)}); give a URDF file"
        ) from None
    chain = _chain(spec, tip, path)
    check_free([joint.name for body in chain for joint in body.joints], held)
    limits = {
        name: _limits(element)
        for element in robot.findall("joint")
        if (name := element.get("name", "")) in {j.name for body in chain for j in body.joints}
    }
    joints, flange = _placed(spec, chain[-1], limits, acceleration)
    if held_angle is None:
        held_angle = dict(enumerate(home or (), 1)).get(held or 0, 0.0)
    middle = [0.5 * (joint.lower + joint.upper) for joint in joints]
    if held is not None:
        middle[held - 1] = held_angle
    arm = Arm(
        name=re.sub(r"[^\w .-]", "_", robot.get("name") or path.stem)[:64],
        joints=tuple(joints),
        held_joint=held,
        held_angle=held_angle,
        flange_xyz=flange[0],
        flange_rpy=flange[1],
        pivot=pivot or (0.0, 0.0, 0.0),
        home=tuple(middle if home is None else home),
    )
    arm = search_home(arm) if home is None else arm
    if pivot:
        return arm
    flange = arm.kinematics(arm.home_free)
    outward = copysign(PIVOT_OUTWARD, float(flange.position[1]))
    return arm.model_copy(update={"pivot": tuple((outward * flange.rotation[1]).tolist())})


def _chain(spec: Any, tip: str | None, path: Path) -> list[Any]:
    """Return the bodies from the root to the tip."""
    links = {body.name: body for body in spec.bodies[1:]}
    parents = {body.parent.name for body in spec.bodies[1:]}
    ends = [name for name in links if name not in parents]
    if tip is None and len(ends) == 1:
        tip = ends[0]
    if tip not in links:
        names = shortened(", ".join(ends), 300)
        raise ArmError(f"{path} has the ends {names}; say which is the flange with tip=")
    body, chain = links[tip], list[Any]()
    while body.parent is not None:
        chain.insert(0, body)
        body = body.parent
    return chain


def _limits(element: ElementTree.Element) -> dict[str, float]:
    """Return the limits of a joint of the chain, as the fields of `Joint`.

    Raises:
        ArmError: The joint does not turn by itself, or has no such limits.
    """
    name, kind = shortened(element.get("name", "")), shortened(element.get("type", ""))
    if element.find("mimic") is not None or kind not in ("revolute", "continuous"):
        raise ArmError(
            f"joint {name} is {kind}, or follows another; between root and tip only revolute, "
            "continuous and fixed joints can be used: choose another tip"
        )
    limit = element.find("limit")
    attributes = {} if limit is None else dict(limit.attrib)
    if kind == "continuous":
        attributes |= {"lower": "-inf", "upper": "inf"}
    try:
        return {
            "lower": max(float(attributes["lower"]), -CONTINUOUS),
            "upper": min(float(attributes["upper"]), CONTINUOUS),
            "velocity": float(attributes["velocity"]),
            "torque": float(attributes["effort"]),
        }
    except (KeyError, ValueError) as error:
        raise ArmError(
            f"joint {name} lacks a limit ({shortened(str(error))}); add it to the file: "
            '<limit lower="..." upper="..." velocity="..." effort="..."/>'
        ) from None


def _placed(
    spec: Any, tip: Any, limits: dict[str, dict[str, float]], acceleration: float
) -> tuple[list[Joint], tuple[Triple, Triple]]:
    """Return the joints of a chain, and the pose of the flange in the frame of the last one."""
    tip.add_site(name="equipoise tip")
    others = [joint for joint in spec.joints if joint.name not in limits]
    for joint in others:
        spec.delete(joint)
    spec.compiler.fusestatic = True
    try:
        for body in spec.bodies[1:]:
            xx, yy, zz, xy, xz, yz = body.fullinertia
            moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            possible = body.mass > 0.0 and moments[0] > 1e-12  # MuJoCo refuses some smaller ones
            possible &= moments[2] <= (moments[0] + moments[1]) * (1.0 + ROUNDING)
            if not possible and limits.keys().isdisjoint(joint.name for joint in body.joints):
                body.fullinertia[0] = np.nan  # a point mass for MuJoCo
        with warnings.catch_warnings(action="error"):
            model = spec.compile()
    except (ValueError, UserWarning) as error:
        raise ArmError(
            f"MuJoCo refuses the chain ({shortened(str(error), 200)}); correct the file, for "
            "example the <inertial> of every moving link"
        ) from None
    site = model.site("equipoise tip")
    joints: list[Joint] = []
    for i in range(model.njnt):
        joint, body = model.joint(i), model.body(model.jnt_bodyid[i])
        axes = rotation_from_quaternion(body.iquat)
        inertia = axes @ np.diag(body.inertia) @ axes.T
        link = Inertial.of(shortened(body.name), float(body.mass[0]), body.ipos, inertia)
        joints.append(
            Joint(
                name=shortened(joint.name),
                xyz=body.pos.tolist(),
                rpy=rpy_from_rotation(rotation_from_quaternion(body.quat)),
                axis=joint.axis.tolist(),
                acceleration=acceleration,
                link=link,
                **limits[joint.name],
            )
        )
    return joints, (site.pos.tolist(), rpy_from_rotation(rotation_from_quaternion(site.quat)))


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Return the rotation of a quaternion of MuJoCo, shape (3, 3)."""
    matrix = np.zeros(9)
    mujoco().mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
