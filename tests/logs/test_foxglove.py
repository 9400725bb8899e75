"""What Foxglove and Lichtblick draw: messages by the published schemas, frames where the arm is."""

import json
from io import BytesIO

import numpy as np
import pytest
from mcap.reader import make_reader

from equipoise.control.policy import shipped_policy
from equipoise.logs.foxglove import RATE
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.scene import scene
from equipoise.model.arms.urdf_writer import write_urdf
from equipoise.rig.simulate import simulate_run

STAMP = {
    "type": "object",
    "required": ["sec", "nsec"],
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}


TYPES = {
    "object": dict,
    "array": list,
    "string": str,
    "integer": int,
    "number": int | float,
}


def check(value, schema):
    """Check a value by a JSON schema, as far as the schemas here go."""
    assert isinstance(value, TYPES[schema["type"]])
    if "minimum" in schema:
        assert schema["minimum"] <= value <= schema.get("maximum", np.inf)
    if schema["type"] == "array":
        for item in value:
            check(item, schema["items"])
    if schema["type"] == "object":
        assert set(schema.get("required", ())) <= set(value)
        if schema.get("additionalProperties") is False:
            assert set(value) <= set(schema["properties"])
        for name, of in schema["properties"].items():
            if name in value:
                check(value[name], of)


def numbers(*names):
    return {
        "type": "object",
        "required": list(names),
        "additionalProperties": False,
        "properties": {name: {"type": "number"} for name in names},
    }


NUMBERS = {"type": "array", "items": {"type": "number"}}
# Typed from github.com/foxglove/foxglove-sdk schemas/jsonschema/FrameTransforms.json, and from
# std_msgs/String.msg and sensor_msgs/JointState.msg of ROS; fields of theirs are required here.
PUBLISHED = {
    "foxglove.FrameTransforms": {
        "type": "object",
        "required": ["transforms"],
        "additionalProperties": False,
        "properties": {
            "transforms": {
                "type": "array",
                "items": {
                    "type": "object",
                    "required": [
                        *("timestamp", "parent_frame_id", "child_frame_id"),
                        *("translation", "rotation"),
                    ],
                    "additionalProperties": False,
                    "properties": {
                        "timestamp": STAMP,
                        "parent_frame_id": {"type": "string"},
                        "child_frame_id": {"type": "string"},
                        "translation": numbers("x", "y", "z"),
                        "rotation": numbers("x", "y", "z", "w"),
                    },
                },
            }
        },
    },
    "sensor_msgs/JointState": {
        "type": "object",
        "required": ["header", "name", "position", "velocity", "effort"],
        "additionalProperties": False,
        "properties": {
            "header": {
                "type": "object",
                "required": ["stamp", "frame_id"],
                "properties": {"stamp": STAMP, "frame_id": {"type": "string"}},
            },
            "name": {"type": "array", "items": {"type": "string"}},
            "position": NUMBERS,
            "velocity": NUMBERS,
            "effort": NUMBERS,
        },
    },
    "std_msgs/String": {
        "type": "object",
        "required": ["data"],
        "additionalProperties": False,
        "properties": {"data": {"type": "string"}},
    },
}
NAMES = {
    "/tf": "foxglove.FrameTransforms",
    "/joint_states": "sensor_msgs/JointState",
    "/robot_description": "std_msgs/String",
}


def messages(path):
    reader = make_reader(BytesIO(path.read_bytes()), validate_crcs=True)
    return [(s, c, m, json.loads(m.data)) for s, c, m in reader.iter_messages()]


def check_messages(found):
    """Check each message by the schema in the file, and by the published one of its name."""
    for schema, _, _, content in found:
        own = json.loads(schema.data)
        check(content, own)
        # The readers of schemas in Foxglove and Lichtblick refuse types that they do not know.
        assert own["type"] == "object"
        assert {one["type"] for one in own["properties"].values()} <= {
            *("number", "integer", "string", "array", "object"),
        }
        if schema.name in PUBLISHED:
            check(content, PUBLISHED[schema.name])
    shown = {channel.topic: schema.name for schema, channel, *_ in found}
    assert {topic: shown[topic] for topic in NAMES} == NAMES


def test_messages_of_a_rig_have_the_published_schemas(rig_log):
    found = messages(rig_log)
    check_messages(found)
    described = [c for _, channel, _, c in found if channel.topic == "/robot_description"]
    urdf = write_urdf(scene(RunLog.load(rig_log).conditions.arm))
    assert described == [{"data": urdf}]
    (attached,) = make_reader(BytesIO(rig_log.read_bytes())).iter_attachments()
    assert (attached.data.decode(), attached.media_type) == (urdf, "application/xml")
    stamps = [m.log_time for _, channel, m, _ in found if channel.topic == "/tf"]
    assert min(np.diff(stamps)) >= 1e9 / RATE
    assert np.median(np.diff(stamps)) < 1.3e9 / RATE


def rotation(q):
    """Matrix of a quaternion, by its definition."""
    x, y, z, w = (q[name] for name in "xyzw")
    v, K = np.array([x, y, z]), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * K


@pytest.mark.compiled_only
def test_frames_stand_where_the_kinematics_puts_flange_and_pendulum(tmp_path):
    run = simulate_run(shipped_policy(), world="twin:nominal", duration=0.5)
    run.save(tmp_path / "run.mcap", command="test")
    arm, compared = run.conditions.arm, 0
    replies = run.replies
    for _, channel, message, content in messages(tmp_path / "run.mcap"):
        if channel.topic != "/tf":
            continue
        assert all(
            t["timestamp"]["sec"] * 10**9 + t["timestamp"]["nsec"] == message.log_time
            for t in content["transforms"]
        )
        place = {"base": (np.eye(3), np.zeros(3))}
        for t in content["transforms"]:
            R, p = place[t["parent_frame_id"]]
            offset = np.array([t["translation"][name] for name in "xyz"])
            place[t["child_frame_id"]] = (R @ rotation(t["rotation"]), p + R @ offset)
        # Log time counts from the first measurement.
        row = int(np.argmin(np.abs(replies.time - replies.time[0] - 1e-9 * message.log_time)))
        pose = arm.kinematics(arm.without_held(replies.q[row]))
        np.testing.assert_allclose(place["flange"][1], pose.position, atol=1e-5)
        np.testing.assert_allclose(place["flange"][0], pose.rotation, atol=1e-5)
        R, p = place["pendulum"]
        np.testing.assert_allclose(p, pose.position + pose.rotation @ arm.pivot, atol=1e-5)
        # The rod leans by phi towards +x: its end, seen from its pivot.
        phi = np.arctan2(*(R @ [0.0, 0.0, 1.0])[[0, 2]])
        tick = np.searchsorted(run.time, replies.time[row], side="right") - 1
        near = run.estimated_phi[max(tick - 2, 0) : tick + 2]
        assert near.min() - 0.01 < phi < near.max() + 0.01 or compared == 0
        compared += 1
    assert compared >= 12
