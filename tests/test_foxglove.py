"""The example for Foxglove: messages by the published schemas, frames where the arm is."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from equipoise.control.policy import shipped_policy
from equipoise.rig.simulate import simulate_run
from tests.arm.witnesses import Pinocchio

EXAMPLE = Path(__file__).parents[1] / "examples" / "foxglove.py"
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


@pytest.fixture(scope="module")
def run():
    return simulate_run(shipped_policy(), world="twin:nominal", duration=0.5)


@pytest.fixture
def shown(run, tmp_path, monkeypatch):
    """Schema, channel, message and content of all messages that the example writes."""
    run.save(tmp_path / "run.mcap")
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "run.mcap")])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    with (tmp_path / "shown.mcap").open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages())
    return [(s, c, m, json.loads(m.data)) for s, c, m in found]


@pytest.mark.compiled_only
def test_the_messages_have_the_published_schemas(shown, run):
    topics = {channel.topic for _, channel, _, _ in shown}
    assert topics >= {"/tick", "/truth", "/stream", "/reply", "/encoder", "/end", *PUBLISHED}
    for schema, channel, _, content in shown:
        if channel.topic in PUBLISHED:
            name, published = PUBLISHED[channel.topic]
            assert schema.name == name
            assert form_of_schema(json.loads(schema.data)) == published == form_of(content)


@pytest.mark.compiled_only
def test_frames_stand_where_the_kinematics_puts_flange_and_pendulum(shown, run):
    arm, replies, compared = run.conditions.arm, run.replies, 0
    urdf = next(c["data"] for _, channel, _, c in shown if channel.topic == "/robot_description")
    robot = Pinocchio(urdf)
    for _, channel, message, content in shown:
        if channel.topic != "/tf":
            continue
        placed = {t["child_frame_id"]: t for t in content["transforms"]}
        assert {t["parent_frame_id"] for t in placed.values()} == {"base"}
        place, turn = (
            {name: np.array(list(t[part].values())) for name, t in placed.items()}
            for part in ("translation", "rotation")
        )
        # Log time counts from the first measurement.
        row = int(np.argmin(np.abs(replies.time - replies.time[0] - 1e-9 * message.log_time)))
        q = replies.q[row]
        pose = arm.kinematics(arm.without_held(q))
        np.testing.assert_allclose(place["flange"], pose.position, atol=1e-9)
        pivot = pose.position + pose.rotation @ arm.pivot
        np.testing.assert_allclose(place["pendulum"], pivot, atol=1e-9)
        # The rod leans by phi towards +x.
        x, y, z, w = turn["pendulum"]
        phi = np.arctan2(2.0 * (x * z + w * y), 1.0 - 2.0 * (x * x + y * y))
        tick = np.searchsorted(run.time, replies.time[row], side="right") - 1
        near = run.estimated_phi[max(tick - 2, 0) : tick + 2]
        assert near.min() - 0.01 < phi < near.max() + 0.01 or compared == 0
        # Another program reads the same out of the description.
        rest = np.zeros(len(q) + 1)
        np.testing.assert_allclose(robot.flange([*q, phi], rest).position, pose.position, atol=1e-9)
        rod = robot.data.oMf[robot.model.getFrameId("pendulum")]
        np.testing.assert_allclose(rod.translation, pivot, atol=1e-9)
        compared += 1
    assert compared >= 12
