"""What Foxglove and Lichtblick draw: messages by the published schemas, frames where the arm is."""

import json
from io import BytesIO

import numpy as np
import pytest
from mcap.reader import make_reader

from equipoise.control.policy import shipped_policy
from equipoise.logs.foxglove import RATE
from equipoise.logs.run_log import RunLog
from equipoise.rig.simulate import simulate_run

TYPES = {"string": str, "integer": int, "number": float}
# Typed from github.com/foxglove/foxglove-sdk schemas/jsonschema/FrameTransforms.json, and from
# std_msgs/String.msg of ROS.
TRANSFORM = {
    "timestamp": {"sec": int, "nsec": int},
    "parent_frame_id": str,
    "child_frame_id": str,
    "translation": dict.fromkeys("xyz", float),
    "rotation": dict.fromkeys("xyzw", float),
}
PUBLISHED = {
    "/tf": ("foxglove.FrameTransforms", {"transforms": [TRANSFORM]}),
    "/robot_description": ("std_msgs/String", {"data": str}),
}


def form_of(value):
    """Return the form of a message: the types of its fields."""
    if isinstance(value, dict):
        return {name: form_of(each) for name, each in value.items()}
    if isinstance(value, list):
        forms = [form_of(each) for each in value]
        assert all(form == forms[0] for form in forms)
        return forms[:1]
    return type(value)


def form_of_schema(schema):
    """Return the form that a JSON schema asks for."""
    if schema["type"] == "object":
        return {name: form_of_schema(each) for name, each in schema["properties"].items()}
    return [form_of_schema(schema["items"])] if schema["type"] == "array" else TYPES[schema["type"]]


def messages(path):
    reader = make_reader(BytesIO(path.read_bytes()), validate_crcs=True)
    return [(s, c, m, json.loads(m.data)) for s, c, m in reader.iter_messages()]


@pytest.mark.full
def test_messages_of_a_rig_have_the_published_schemas(rig_log):
    found = [each for each in messages(rig_log) if each[1].topic in PUBLISHED]
    for schema, channel, _, content in found:
        name, published = PUBLISHED[channel.topic]
        assert schema.name == name
        assert form_of_schema(json.loads(schema.data)) == published == form_of(content)
    (described,) = [c["data"] for _, channel, _, c in found if channel.topic != "/tf"]
    (attached,) = make_reader(BytesIO(rig_log.read_bytes())).iter_attachments()
    assert (attached.data.decode(), attached.media_type) == (described, "application/xml")
    joints = RunLog.load(rig_log).conditions.joints
    assert all(f'<joint name="{joint}"' in described for joint in joints)
    steps = np.diff([m.log_time for _, channel, m, _ in found if channel.topic == "/tf"])
    assert min(steps) >= 1e9 / RATE
    assert np.median(steps) < 1.3e9 / RATE


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
        place = {"base": (np.eye(3), np.zeros(3))}
        for t in content["transforms"]:
            assert t["timestamp"]["sec"] * 10**9 + t["timestamp"]["nsec"] == message.log_time
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
