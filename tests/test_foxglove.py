"""The example for Foxglove: frames where the arm is."""

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


@pytest.fixture(scope="module")
def run():
    return simulate_run(shipped_policy(), world="twin:nominal", duration=0.5)


@pytest.fixture
def shown(run, tmp_path, monkeypatch):
    """Channel, message and content of all messages that the example writes."""
    run.save(tmp_path / "run.mcap")
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "run.mcap")])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    with (tmp_path / "shown.mcap").open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages())
    return [(c, m, json.loads(m.data)) for _, c, m in found]


@pytest.mark.compiled_only
def test_frames_stand_where_the_kinematics_puts_flange_and_pendulum(shown, run):
    arm, replies, compared = run.conditions.arm, run.replies, 0
    urdf = next(c["data"] for channel, _, c in shown if channel.topic == "/robot_description")
    robot = Pinocchio(urdf)
    for channel, message, content in shown:
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
