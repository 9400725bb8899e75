"""The drawing of an arm with its pendulum as a URDF, for other viewers.

Links, joints and their shapes are the bodies, hinges and capsules of `equipoise.model.arms.scene`.
Limits and masses are left out. The joint angle of the pendulum is phi, zero upright.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from typing import Any

import numpy as np

from equipoise.model.arms.chain import rpy_from_rotation, turned_to
from equipoise.model.arms.urdf import rotation_from_quaternion
from equipoise.model.physics_engine import mujoco

BASE = "base"
"""Name of the fixed link; its frame is that of the arm."""


def write_urdf(spec: Any) -> str:
    """Return a scene as the text of a URDF file.

    Args:
        spec: From `scene`.
    """
    robot = ElementTree.Element("robot", name=spec.modelname)
    _link(robot, BASE, spec.worldbody)
    for body in spec.bodies[1:]:
        _link(robot, body.name, body)
        name, kind, (hinge, *_) = f"to {body.name}", "fixed", [*body.joints, None]
        if hinge is not None:
            name, kind = hinge.name, "continuous"
        joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
        parent = BASE if body.parent.parent is None else body.parent.name
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=body.name)
        rpy = rpy_from_rotation(rotation_from_quaternion(body.quat))
        ElementTree.SubElement(joint, "origin", xyz=_text(body.pos), rpy=_text(rpy))
        if hinge is not None:
            axis = np.array(hinge.axis)
            ElementTree.SubElement(joint, "axis", xyz=_text(axis / np.linalg.norm(axis)))
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _link(robot: ElementTree.Element, name: str, body: Any) -> None:
    """Add a link with the capsules of a body, as cylinders."""
    link = ElementTree.SubElement(robot, "link", name=name)
    for geom in body.geoms:
        if geom.type != mujoco().mjtGeom.mjGEOM_CAPSULE:
            continue
        start, end = np.array(geom.fromto[:3]), np.array(geom.fromto[3:])
        length = float(np.linalg.norm(end - start))
        visual = ElementTree.SubElement(link, "visual", name=geom.name)
        rpy = rpy_from_rotation(turned_to(end - start))  # a cylinder lies along z
        ElementTree.SubElement(visual, "origin", xyz=_text(0.5 * (start + end)), rpy=_text(rpy))
        geometry = ElementTree.SubElement(visual, "geometry")
        size = {"radius": repr(float(geom.size[0])), "length": repr(length)}
        ElementTree.SubElement(geometry, "cylinder", size)
        material = ElementTree.SubElement(visual, "material", name=geom.name)
        rgba = "0.0 0.45 0.7 1" if geom.name == "rod" else "0.9 0.9 0.92 1"
        ElementTree.SubElement(material, "color", rgba=rgba)


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
