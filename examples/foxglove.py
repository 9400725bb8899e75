"""Add the arm in 3D to a run log, for Foxglove and Lichtblick.

python examples/foxglove.py [run.mcap] [shown.mcap]

Their 3D panels read two schemas by name, which the copy has besides the messages of the log:

    /robot_description  std_msgs/String            URDF of arm and pendulum, once
    /tf                 foxglove.FrameTransforms   frame of each link in `base`, 25 times a second

The joints are the measured ones, and the angle of the pendulum is its estimate. Switch on the topic
`/robot_description` in the panel's list of topics.
"""

import json
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

import equipoise as eq
from equipoise.arm.scene import scene
from equipoise.physics_engine import mujoco

RATE = 25.0  # of the transforms [Hz], that of a film


def fields(**properties: Any) -> dict[str, Any]:
    """Return the JSON schema of an object."""
    return {"type": "object", "properties": properties}


NUMBER, INTEGER, TEXT = ({"type": kind} for kind in ("number", "integer", "string"))
TRANSFORM = fields(
    timestamp=fields(sec=INTEGER, nsec=INTEGER),
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=fields(**dict.fromkeys("xyz", NUMBER)),
    rotation=fields(**dict.fromkeys("xyzw", NUMBER)),
)


def describe(spec: Any) -> str:
    """Return the bodies, hinges and capsules of a scene as the text of a URDF."""
    robot = ElementTree.Element("robot", name=spec.modelname)
    for body in spec.bodies:
        link = ElementTree.SubElement(robot, "link", name=link_name(body))
        for geom in body.geoms:
            if geom.type == mujoco().mjtGeom.mjGEOM_CAPSULE:
                add_cylinder(link, geom)
        if body.parent is None:
            continue
        hinge = body.joints[0] if body.joints else None
        name, kind = (hinge.name, "continuous") if hinge else (f"to {body.name}", "fixed")
        joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
        ElementTree.SubElement(joint, "parent", link=link_name(body.parent))
        ElementTree.SubElement(joint, "child", link=body.name)
        turn = Rotation.from_quat(body.quat, scalar_first=True)
        ElementTree.SubElement(joint, "origin", xyz=text(body.pos), rpy=text(turn.as_euler("xyz")))
        if hinge:
            axis = np.array(hinge.axis)
            ElementTree.SubElement(joint, "axis", xyz=text(axis / np.linalg.norm(axis)))
    return ElementTree.tostring(robot, encoding="unicode")


def add_cylinder(link: ElementTree.Element, geom: Any) -> None:
    """Add a capsule to a link, as a cylinder, which lies along z."""
    start, end = np.array(geom.fromto[:3]), np.array(geom.fromto[3:])
    x, y, z = end - start
    rpy = 0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    visual = ElementTree.SubElement(link, "visual", name=geom.name)
    ElementTree.SubElement(visual, "origin", xyz=text(0.5 * (start + end)), rpy=text(rpy))
    size = {"radius": str(geom.size[0]), "length": str(np.linalg.norm(end - start))}
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), "cylinder", size)
    material = ElementTree.SubElement(visual, "material", name=geom.name)
    rgba = "0.0 0.45 0.7 1" if geom.name == "rod" else "0.9 0.9 0.92 1"
    ElementTree.SubElement(material, "color", rgba=rgba)


def link_name(body: Any) -> str:
    """Return the name of the link of a body; MuJoCo's world is the base of the arm."""
    return "base" if body.parent is None else body.name


def text(values: Any) -> str:
    """Return numbers as a URDF writes them."""
    return " ".join(repr(float(value)) for value in values)


def transforms(model: Any, data: Any, stamp: int) -> list[dict[str, Any]]:
    """Return the frame of each link in the base, for the posture in `data`."""
    mujoco().mj_kinematics(model, data)
    frames: list[dict[str, Any]] = []
    for i in range(1, model.nbody):  # the first body is the world
        w, x, y, z = data.xquat[i].tolist()
        frames.append(
            {
                "timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9},
                "parent_frame_id": "base",
                "child_frame_id": model.body(i).name,
                "translation": dict(zip("xyz", data.xpos[i].tolist(), strict=True)),
                "rotation": {"x": x, "y": y, "z": z, "w": w},
            }
        )
    return frames


def main(log: Path, shown: Path) -> None:
    """Write the copy of a log with the messages for a 3D panel."""
    spec = scene(eq.RunLog.load(log, damaged=True).conditions.arm)
    model = spec.compile()
    data = mujoco().MjData(model)
    phi, due, channels = np.pi, 0, dict[int, int]()
    with log.open("rb") as source, shown.open("wb") as target:
        writer = Writer(target)
        writer.start()

        def channel(topic: str, schema: str, content: bytes) -> int:
            number = writer.register_schema(schema, "jsonschema", content)
            return writer.register_channel(topic, "json", number)

        text_of = json.dumps(fields(data=TEXT)).encode()
        frames_of = json.dumps(fields(transforms={"type": "array", "items": TRANSFORM})).encode()
        described = channel("/robot_description", "std_msgs/String", text_of)
        framed = channel("/tf", "foxglove.FrameTransforms", frames_of)
        urdf = json.dumps({"data": describe(spec)}).encode()
        writer.add_message(described, 0, urdf, 0)
        for schema, written, message in make_reader(source).iter_messages():
            if schema is not None and written.id not in channels:
                channels[written.id] = channel(written.topic, schema.name, schema.data)
            stamp = message.log_time
            writer.add_message(channels[written.id], stamp, message.data, stamp)
            row: Any = json.loads(message.data)
            if written.topic == "/tick":
                phi = row.get("estimated_phi", phi)
            if written.topic == "/reply" and "q" in row and stamp >= due:
                due = stamp + round(1e9 / RATE)
                data.qpos[:] = [*row["q"], phi]
                frames = json.dumps({"transforms": transforms(model, data, stamp)}).encode()
                writer.add_message(framed, stamp, frames, stamp)
        writer.finish()
    print(f"wrote {shown}; open it in Foxglove or Lichtblick")


if len(sys.argv) > 1:
    run = Path(sys.argv[1])
else:
    run = Path("run.mcap")
    eq.simulate_run(world="twin:nominal", duration=1.0).save(run)
main(run, Path(sys.argv[2]) if len(sys.argv) > 2 else run.with_name("shown.mcap"))
