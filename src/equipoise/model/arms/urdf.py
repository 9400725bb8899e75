"""Arms from URDF files: the chain of revolute joints between two links.

Fixed joints become part of the next origin (or of the flange). URDF knows no limits of
accelerations, no home and no pendulum: these are arguments.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Final

import numpy as np

from equipoise.artefacts import MEBIBYTE, StrPath, quoted, read_bytes, shortened
from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm, Joint
from equipoise.model.arms.chain import Floats, Triple, rotation_from_rpy, rpy_from_rotation
from equipoise.model.arms.iiwa import ACCELERATION
from equipoise.model.arms.posture import search_home

CONTINUOUS = 20.0 * pi
"""Limit of a continuous joint, and of one whose limits are wider: ten turns each way [rad]."""
LARGEST_URDF: Final = 2 * MEBIBYTE
"""Size limit of a URDF [bytes]: humanoids with hands need less than 1 MB."""
MOST_LINKS: Final = 1000
"""Limit on the number of links; humanoids with hands have about a hundred."""
LONGEST_LIST: Final = 300
"""Number of characters that a message spends on a list of names."""

Element = ElementTree.Element


def read_urdf(
    path: StrPath,
    *,
    base: str | None = None,
    tip: str | None = None,
    held: int | str | None = None,
    held_angle: float = 0.0,
    home: Sequence[float] | None = None,
    pivot: Triple = (0.0, 0.0, 0.0),
    acceleration: float = ACCELERATION,
) -> Arm:
    """Read an arm from a URDF file.

    Args:
        path: The file.
        base: Link that stands still, z up; by default the root.
        tip: Link that is the flange; by default the only end of the tree.
        held: Joint that is held, by name or counted from one along the chain.
        held_angle: Where it is held [rad].
        home: Posture at x = 0, all joints [rad]; by default one is searched (`search_home`).
        pivot: The pendulum's pivot in the flange frame [m].
        acceleration: Acceleration limit of every joint [rad/s^2].

    Raises:
        ArmError: The file is no URDF, or its chain is not an arm with six free joints.
    """
    path = Path(path)
    robot = _parsed(path)
    elements = _chain(robot, base, tip, path)
    joints: list[Joint] = []
    rotation, offset = np.eye(3), np.zeros(3)  # of fixed joints since the last that turns
    for element in elements:
        xyz, rpy = _origin(element)
        if offset.any() or not np.array_equal(rotation, np.eye(3)):
            xyz = _triple(offset + rotation @ xyz)
            rpy = rpy_from_rotation(rotation @ rotation_from_rpy(rpy))
        if element.get("type") == "fixed":
            rotation, offset = rotation_from_rpy(rpy), np.array(xyz)
            continue
        joints.append(_joint(element, xyz, rpy, acceleration))
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
        pivot=pivot,
        home=tuple(middle if home is None else home),
    )
    return search_home(arm) if home is None else arm


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
    return _vector(joint, origin, "xyz", "0 0 0"), _vector(joint, origin, "rpy", "0 0 0")


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
    limits = {key: _numbers(element, limit.get(key, ""), 1)[0] for key in wanted}
    return Joint(
        name=name,
        xyz=xyz,
        rpy=rpy,
        axis=_vector(element, element.find("axis"), "xyz", "1 0 0"),
        lower=max(limits.get("lower", -CONTINUOUS), -CONTINUOUS),
        upper=min(limits.get("upper", CONTINUOUS), CONTINUOUS),
        velocity=limits["velocity"],
        acceleration=acceleration,
        torque=limits["effort"],
    )


def _vector(joint: Element, element: Element | None, key: str, default: str) -> Triple:
    text = default if element is None else element.get(key, default)
    return _triple(_numbers(joint, text, 3))


def _numbers(joint: Element, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ArmError(
            f"joint {_name(joint)} has {quoted(text)} where {count} number(s) belong; correct it"
        )
    return numbers


def _triple(vector: Sequence[float] | Floats) -> Triple:
    x, y, z = vector
    return float(x), float(y), float(z)
