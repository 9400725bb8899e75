"""Arms as URDF files with simple shapes, for other programs and viewers.

Links are named after their joints, between `base` and `flange`; the held joint of an arm with seven
joints is a joint like the others. The pendulum is drawn as a rod that turns about base y at home:
its joint angle is phi, zero upright.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from math import acos, atan2, hypot
from typing import Final, NamedTuple

from equipoise.model.arms.arm import Arm, Joint
from equipoise.model.arms.chain import Triple, rpy_from_rotation
from equipoise.model.arms.scene import SIZES

PENDULUM: Final = "pendulum"
"""Name of the pendulum's link and joint."""
UPRIGHT: Final = (0.0, 1.0, 0.0)
"""Axis of the pendulum, base y at home."""


class UrdfLink(NamedTuple):
    """Link of a URDF with the joint to its parent link."""

    name: str
    """Name of the link."""
    parent: str
    """Name of the parent link."""
    joint: str
    """Name of the joint."""
    xyz: Triple
    """Origin in the frame of the parent [m]."""
    rpy: Triple
    """Roll, pitch and yaw in the frame of the parent at zero [rad]."""
    axis: Triple
    """Axis of the joint in the link's frame, of length 1."""
    turns: bool
    """Whether the joint turns; else it is fixed."""


def describe_links(arm: Arm, *, pendulum: bool = False) -> list[UrdfLink]:
    """Return the links of an arm from `base` (excluded) to the flange.

    Args:
        arm: The arm.
        pendulum: Whether to add the pendulum behind the flange.
    """
    made: list[UrdfLink] = []
    parent = "base"
    for joint in arm.joints:
        name, axis = f"{joint.name}_link", joint.axis
        length = hypot(*axis)
        unit = (axis[0] / length, axis[1] / length, axis[2] / length)
        made.append(UrdfLink(name, parent, joint.name, joint.xyz, joint.rpy, unit, True))
        parent = name
    made.append(
        UrdfLink("flange", parent, "to_flange", arm.flange_xyz, arm.flange_rpy, UPRIGHT, False)
    )
    if pendulum:
        level = rpy_from_rotation(arm.pose(arm.home_free).rotation.T)
        made.append(UrdfLink(PENDULUM, "flange", PENDULUM, arm.pivot, level, UPRIGHT, True))
    return made


def write_urdf(arm: Arm, *, pendulum: bool = False) -> str:
    """Return an arm as the text of a URDF file; `read_urdf` with `tip="flange"` reads it again.

    Left out are masses, acceleration limits, the home posture and the held joint.

    Args:
        arm: The arm.
        pendulum: Whether to add the pendulum to the flange.
    """
    robot = ElementTree.Element("robot", name=arm.name)
    links = describe_links(arm, pendulum=pendulum)
    joints = {joint.name: joint for joint in arm.joints}
    ElementTree.SubElement(robot, "link", name="base")
    for link in links:
        element = ElementTree.SubElement(robot, "link", name=link.name)
        following = next((other.xyz for other in links if other.parent == link.name), None)
        if link.name == PENDULUM:
            _rod(element, (0.0, 0.0, SIZES.rod_length), SIZES.rod, "0.0 0.45 0.7 1")
        elif following is not None and hypot(*following) > 0.0:
            _rod(
                element,
                following,
                0.6 * SIZES.link if link.turns else SIZES.bracket,
                "0.9 0.9 0.92 1",
            )
    for link in links:
        _joint(robot, link, joints.get(link.joint))
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _joint(robot: ElementTree.Element, link: UrdfLink, joint: Joint | None) -> None:
    kind = "fixed" if not link.turns else "continuous" if joint is None else "revolute"
    element = ElementTree.SubElement(robot, "joint", name=link.joint, type=kind)
    ElementTree.SubElement(element, "parent", link=link.parent)
    ElementTree.SubElement(element, "child", link=link.name)
    ElementTree.SubElement(element, "origin", xyz=_text(link.xyz), rpy=_text(link.rpy))
    if link.turns:
        ElementTree.SubElement(element, "axis", xyz=_text(link.axis))
    if joint is not None:
        limits = {"lower": joint.lower, "upper": joint.upper}
        limits |= {"velocity": joint.velocity, "effort": joint.torque}
        texts = {name: repr(value) for name, value in limits.items()}
        ElementTree.SubElement(element, "limit", texts)


def _rod(link: ElementTree.Element, end: Triple, radius: float, colour: str) -> None:
    """Add a cylinder from the link's origin to `end` [m], of a colour in RGBA."""
    x, y, z = end
    length = hypot(x, y, z)
    visual = ElementTree.SubElement(link, "visual")
    # A cylinder lies along z: tilt it, then turn it about z.
    tilt = acos(max(-1.0, min(1.0, z / length)))
    middle = (0.5 * x, 0.5 * y, 0.5 * z)
    ElementTree.SubElement(visual, "origin", xyz=_text(middle), rpy=_text((0.0, tilt, atan2(y, x))))
    geometry = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(geometry, "cylinder", radius=repr(radius), length=repr(length))
    material = ElementTree.SubElement(visual, "material", name=colour)
    ElementTree.SubElement(material, "color", rgba=colour)


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
