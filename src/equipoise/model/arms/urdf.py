"""Arms from URDF files: the chain of revolute joints between two links, with its masses.

Fixed joints become part of the next origin (or of the flange). Everything that a moving link
carries outside the chain (fixed links, tools, grippers at zero) is merged into its mass and
inertia. URDF holds no limits of accelerations, no home and no pendulum: these are arguments.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from math import copysign, pi
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from equipoise.artefacts import MEBIBYTE, StrPath, quoted, read_bytes, shortened
from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm, Inertial, Joint
from equipoise.model.arms.chain import Floats, Triple, rotation_from_rpy, rpy_from_rotation
from equipoise.model.arms.iiwa import ACCELERATION, PIVOT_OUTWARD
from equipoise.model.arms.inertials import inertia_entries, inertia_matrix
from equipoise.model.arms.posture import search_home

CONTINUOUS = 20.0 * pi
"""Largest position limit of a joint, that of a continuous one: ten turns each way [rad]."""
LARGEST_URDF: Final = 2 * MEBIBYTE
"""Size limit of a URDF [bytes]: humanoids with hands need less than 1 MB."""
MOST_LINKS: Final = 1000
"""Limit on the number of links; humanoids with hands have about a hundred."""
LONGEST_LIST: Final = 300
"""Maximum length of a list of names in a message [characters]."""

MOMENTS: Final = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of <inertia>, in the order of `Inertial.inertia`."""

Element = ElementTree.Element


def read_urdf(
    path: StrPath,
    *,
    base: str | None = None,
    tip: str | None = None,
    held: int | str | None = None,
    held_angle: float = 0.0,
    home: Sequence[float] | None = None,
    pivot: Triple | None = None,
    acceleration: float = ACCELERATION,
) -> Arm:
    """Read an arm from a URDF file.

    Args:
        path: The file.
        base: Fixed link, z up; by default the root.
        tip: Link of the flange; by default the only end of the tree.
        held: Joint that does not move, by name or counted from one along the chain.
        held_angle: Its angle [rad].
        home: Posture at x = 0, all joints [rad]; by default the result of `search_home`.
        pivot: The pendulum's pivot in the flange frame [m]; by default beside the flange, along
            the spindle at home and away from the base.
        acceleration: Acceleration limit of every joint [rad/s^2].

    Raises:
        ArmError: The file is no URDF, or its chain is not an arm with six free joints.
    """
    path = Path(path)
    robot = _parsed(path)
    elements = _chain(robot, base, tip, path)
    carried = _carried(robot, elements)
    joints: list[Joint] = []
    rotation, offset = np.eye(3), np.zeros(3)  # of fixed joints since the last moving one
    for element in elements:
        xyz, rpy = _origin(element)
        if offset.any() or not np.array_equal(rotation, np.eye(3)):
            xyz = _triple(offset + rotation @ xyz)
            rpy = rpy_from_rotation(rotation @ rotation_from_rpy(rpy))
        if element.get("type") == "fixed":
            rotation, offset = rotation_from_rpy(rpy), np.array(xyz)
            continue
        joint = _joint(element, xyz, rpy, acceleration)
        joints.append(joint.model_copy(update={"link": carried[_end(element, "child")]}))
        rotation, offset = np.eye(3), np.zeros(3)
    names = [joint.name for joint in joints]
    if isinstance(held, str):
        if held not in names:
            raise ArmError(
                f"{path} has no joint {shortened(held)} to hold; choose one of {_listed(names)}"
            )
        held = names.index(held) + 1
    middle = [0.5 * (joint.lower + joint.upper) for joint in joints]
    if held is not None and 1 <= held <= len(joints):
        middle[held - 1] = held_angle
    arm = Arm(
        name=re.sub(r"[^\w .-]", "_", robot.get("name") or path.stem)[:64],
        joints=tuple(joints),
        held_joint=held,
        held_angle=held_angle,
        flange_xyz=_triple(offset),
        flange_rpy=rpy_from_rotation(rotation),
        pivot=pivot or (0.0, 0.0, 0.0),
        home=tuple(middle if home is None else home),
    )
    arm = search_home(arm) if home is None else arm
    return arm if pivot else arm.model_copy(update={"pivot": _beside_flange(arm)})


def _beside_flange(arm: Arm) -> Triple:
    """Return the pivot along the spindle at home, away from the base [m]."""
    flange = arm.pose(arm.home_free)
    outward = copysign(PIVOT_OUTWARD, float(flange.position[1]))
    return _triple(outward * flange.rotation[1])


def _parsed(path: Path) -> Element:
    data = read_bytes(path, LARGEST_URDF, "a URDF", ArmError)
    try:
        robot = ElementTree.fromstring(data, ElementTree.XMLParser(target=_Tree()))
    except ElementTree.ParseError as error:
        raise ArmError(f"{path} is not XML ({error}); give a URDF file") from None
    except (LookupError, ValueError) as error:  # of a codec, or a definition of entities
        raise ArmError(
            f"{path} cannot be read as XML ({shortened(str(error))}); save it in UTF-8 without "
            "definitions of entities"
        ) from None
    if robot.tag != "robot":
        raise ArmError(
            f"{path} starts with <{shortened(robot.tag)}>, expected <robot>; give a URDF file"
        )
    if (links := len(robot.findall("link"))) > MOST_LINKS:
        raise ArmError(f"{path} has {links:,} links, expected at most {MOST_LINKS:,}")
    return robot


class _Tree(ElementTree.TreeBuilder):
    """Builder of elements that refuses a document type."""

    def doctype(self, *_: str | None) -> None:
        """Refuse: the entities of a document type can grow a small file to gigabytes."""
        raise ValueError("it has a document type")


def _chain(robot: Element, base: str | None, tip: str | None, path: Path) -> list[Element]:
    """Return the joints from `base` to `tip`."""
    names = [link.get("name", "") for link in robot.findall("link")]
    above = {_end(joint, "child"): joint for joint in robot.findall("joint")}
    parents = {_end(joint, "parent") for joint in above.values()}
    base = _link(base, [name for name in names if name not in above], "base", names, path)
    chain_of = {name: _way_down(name, base, above) for name in names}
    ends = [name for name in names if name not in parents and chain_of[name] is not None]
    tip = _link(tip, ends, "tip", names, path)
    chain = chain_of[tip]
    if chain is None:
        raise ArmError(f"{path} has no chain from {base} to {tip}; give another base or tip")
    return chain


def _way_down(link: str, base: str, above: dict[str, Element]) -> list[Element] | None:
    chain: list[Element] = []
    while link != base:
        if link not in above or len(chain) > len(above):
            return None
        chain.append(above[link])
        link = _end(chain[-1], "parent")
    return chain[::-1]


class _Part(NamedTuple):
    """A link that a moving link carries, with its <inertial> in the moving link's frame."""

    name: str
    """Name of the link."""
    mass: float
    """Mass [kg]; zero if the file has none."""
    com: Floats
    """Centre of mass [m], shape (3,)."""
    inertia: Floats
    """Inertia about it [kg m^2], shape (3, 3); zero if the file has none."""


def _carried(robot: Element, chain: list[Element]) -> Mapping[str, Inertial]:
    """Return mass and inertia behind each moving joint, by the name of the link that it moves."""
    links = {link.get("name", ""): link for link in robot.findall("link")}
    moving = {_end(joint, "child") for joint in chain if joint.get("type") != "fixed"}
    below: dict[str, list[Element]] = {}
    for joint in robot.findall("joint"):
        below.setdefault(_end(joint, "parent"), []).append(joint)
    result: dict[str, Inertial] = {}
    for name in moving:
        parts: list[_Part] = []
        waiting, seen = [(name, np.eye(3), np.zeros(3))], {name}
        while waiting:
            link, rotation, offset = waiting.pop()
            parts += _part(link, links.get(link), rotation, offset)
            for joint in below.get(link, []):
                child = _end(joint, "child")
                if child not in moving and child not in seen:
                    seen.add(child)
                    xyz, rpy = _origin(joint)
                    turned = rotation @ rotation_from_rpy(rpy)
                    waiting.append((child, turned, offset + rotation @ xyz))
        result[name] = _merged(name, parts)
    return result


def _part(name: str, link: Element | None, rotation: Floats, offset: Floats) -> list[_Part]:
    """Return a link as a part, or nothing where it has neither mass nor inertia."""
    inertial = None if link is None else link.find("inertial")
    if inertial is None:
        return []
    where = f"<inertial> of link {shortened(name)}"
    mass, inertia, origin = (inertial.find(tag) for tag in ("mass", "inertia", "origin"))
    xyz, rpy = (_vector(where, origin, key, "0 0 0") for key in ("xyz", "rpy"))
    kilograms = 0.0 if mass is None else _numbers(where, mass.get("value", "0"), 1)[0]
    moments = [
        0.0 if inertia is None else _numbers(where, inertia.get(key, "0"), 1)[0] for key in MOMENTS
    ]
    if kilograms == 0.0 and not any(moments):
        return []
    turned = rotation @ rotation_from_rpy(rpy)
    matrix = turned @ inertia_matrix(moments) @ turned.T
    return [_Part(name, kilograms, offset + rotation @ xyz, matrix)]


def _merged(name: str, parts: list[_Part]) -> Inertial:
    """Return the inertial of links that are fixed to each other, in the frame of the first.

    One without mass or without inertia is returned alone, for a twin to name it.
    """
    lacking = [part for part in parts if not (part.mass and part.inertia.any())]
    if lacking or not parts:
        part = lacking[0] if lacking else _Part(name, 0.0, np.zeros(3), np.zeros((3, 3)))
        return _inertial(*part)
    masses = np.array([part.mass for part in parts])
    com = np.average([part.com for part in parts], axis=0, weights=masses)
    inertia = np.zeros((3, 3))
    for part in parts:
        d = part.com - com
        inertia += part.inertia + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return _inertial(name, float(masses.sum()), com, inertia)


def _inertial(name: str, mass: float, com: Floats, inertia: Floats) -> Inertial:
    return Inertial(
        name=shortened(name), mass=mass, com=_triple(com), inertia=inertia_entries(inertia)
    )


def _link(chosen: str | None, possible: list[str], which: str, names: list[str], path: Path) -> str:
    if chosen is not None:
        if chosen not in names:
            raise ArmError(
                f"{path} has no link {shortened(chosen)}; its links are {_listed(names)}"
            )
        return chosen
    if len(possible) != 1:
        found = f"its {which} could be {_listed(possible)}" if possible else "it has no links"
        raise ArmError(f"{path} is not one chain: {found}; say which with {which}=")
    return possible[0]


def _listed(names: list[str]) -> str:
    return shortened(", ".join(names), LONGEST_LIST)


def _end(joint: Element, which: str) -> str:
    end = joint.find(which)
    if end is None or not end.get("link"):
        raise ArmError(f"joint {_name(joint)} has no <{which} link=...>; give a whole URDF")
    return end.get("link", "")


def _name(joint: Element) -> str:
    return shortened(joint.get("name", ""))


def _origin(joint: Element) -> tuple[Triple, Triple]:
    origin = joint.find("origin")
    where = f"joint {_name(joint)}"
    return _vector(where, origin, "xyz", "0 0 0"), _vector(where, origin, "rpy", "0 0 0")


def _joint(element: Element, xyz: Triple, rpy: Triple, acceleration: float) -> Joint:
    name, kind = _name(element), shortened(element.get("type", ""))
    follows = element.find("mimic") is not None
    if follows or kind not in ("revolute", "continuous"):
        raise ArmError(
            f"joint {name} {'follows another' if follows else f'is {kind}'}; between base and tip "
            "only revolute, continuous and fixed joints can be used: choose another base or tip"
        )
    limit = element.find("limit")
    wanted = ["velocity", "effort"] + (["lower", "upper"] if kind == "revolute" else [])
    missing = [key for key in wanted if limit is None or limit.get(key) is None]
    if limit is None or missing:
        raise ArmError(
            f"joint {name} has no limit of {', '.join(missing)}; add it to the file: "
            '<limit lower="..." upper="..." velocity="..." effort="..."/>'
        )
    where = f"joint {name}"
    limits = {key: _numbers(where, limit.get(key, ""), 1)[0] for key in wanted}
    return Joint(
        name=name,
        xyz=xyz,
        rpy=rpy,
        axis=_vector(where, element.find("axis"), "xyz", "1 0 0"),
        lower=max(limits.get("lower", -CONTINUOUS), -CONTINUOUS),
        upper=min(limits.get("upper", CONTINUOUS), CONTINUOUS),
        velocity=limits["velocity"],
        acceleration=acceleration,
        torque=limits["effort"],
    )


def _vector(where: str, element: Element | None, key: str, default: str) -> Triple:
    text = default if element is None else element.get(key, default)
    return _triple(_numbers(where, text, 3))


def _numbers(where: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ArmError(f"{where} has {quoted(text)} where {count} number(s) belong; correct it")
    return numbers


def _triple(vector: Sequence[float] | Floats) -> Triple:
    x, y, z = vector
    return float(x), float(y), float(z)
