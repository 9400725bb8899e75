"""The examples run as they are printed, in an empty folder; that for Foxglove shows the arm."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from equipoise import shipped_policy, simulate_run
from tests.arm.witnesses import Pinocchio
from tests.conftest import tiers

EXAMPLES = Path(__file__).parents[1] / "examples"
PIPELINE = "pipeline.py"  # docs/tutorial.md links it
LONG = (PIPELINE, "train_and_evaluate.py", "lqr.py", "mpc.py", "swing_up.py", "arm_from_a_urdf.py")
PICTURED = ("lqr", "mpc", "delay_of_a_log", "swing_up", "arm_from_a_urdf")
SAY = {
    PIPELINE: "200 of 200 trials survived 60 s",
    "identify_a_swing.py": "w2 = m g l / I",
    "train_and_evaluate.py": "LQR, snapped survived 200 of 200 trials",
    "own_policy.py": "5 of 5 trials survived 10 s",
    "policy_table.py": "    -10     10     50    inf",
    "foxglove.py": "open it in Foxglove",
    "deploy_on_the_twin.py": "twin:nominal: survived 20 of 20 s",
    "lqr.py": "LQR: survived after 10 s",
    "mpc.py": "MPC: survived after 10 s",
    "delay_of_a_log.py": "a setpoint acts after 10.0 ms (95 %: 9.9 to 10.1 ms), by the law kst",
    "swing_up.py": "from hanging: survived",
    "arm_from_a_urdf.py": "elbow 6, 6 joints: survived after 10 s",
}


def test_every_example_is_run():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SAY)


@pytest.mark.parametrize("name", tiers(SAY, SAY.keys() - LONG, LONG))
def test_an_example_needs_no_file_and_says_what_it_should(script, name):
    assert SAY[name] in script(EXAMPLES / name)
    assert [path.stem for path in Path().glob("*.png")] == [name[:-3]] * (name[:-3] in PICTURED)


# Frames in Foxglove


def test_frames_stand_where_the_kinematics_puts_flange_and_pendulum(script, tmp_path):
    run = simulate_run(shipped_policy(), world="twin:nominal", duration=0.5)
    run.save(tmp_path / "run.mcap")
    script(EXAMPLES / "foxglove.py", tmp_path / "run.mcap")
    with (tmp_path / "shown.mcap").open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages())
    contents = {"/robot_description": [], "/tf": []}
    for _, channel, message in found:
        contents.setdefault(channel.topic, []).append((message, json.loads(message.data)))
    arm, replies, compared = run.conditions.arm, run.replies, 0
    ((_, description),) = contents["/robot_description"]
    robot = Pinocchio(description["data"])
    for message, content in contents["/tf"]:
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
        near = run.ticks.estimated_phi[max(tick - 2, 0) : tick + 2]
        assert near.min() - 0.01 < phi < near.max() + 0.01 or compared == 0
        # Another program reads the same out of the description.
        rest = np.zeros(len(q) + 1)
        np.testing.assert_allclose(robot.flange([*q, phi], rest).position, pose.position, atol=1e-9)
        rod = robot.data.oMf[robot.model.getFrameId("pendulum")]
        np.testing.assert_allclose(rod.translation, pivot, atol=1e-9)
        compared += 1
    assert compared >= 12
