"""Compiled kinematics against Pinocchio, MuJoCo, slow loops and finite differences.

States are random over the limits of the joints, velocities up to 3 rad/s. The tolerance of 1e-9 is
far above the rounding of some hundred operations on numbers of order 1 to 100 (1e-13) and far
below any error of a formula.
"""

import numpy as np
import pytest

from equipoise.arm.chain import wrist_centre
from equipoise.arm.compiler import (
    FRAME_SIZE,
    J_DOT_DQ,
    JACOBIAN,
    POSITION,
    ROTATION,
    TWIST,
    addresses,
)
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import call, kernel
from tests.arm.witnesses import ARMS, MuJoCo, Pinocchio

STATES = 200
TOLERANCE = 1e-9


@kernel
def frames_of(kinematics, q, dq, frames):
    """Fill one record per state, a block of lanes at a time; the last block may be part full."""
    q_block, dq_block = np.zeros(6 * BATCH_SIZE), np.zeros(6 * BATCH_SIZE)
    frame_block = np.zeros(FRAME_SIZE * BATCH_SIZE)
    for first in range(0, q.shape[0], BATCH_SIZE):
        lanes = min(BATCH_SIZE, q.shape[0] - first)
        for n in range(lanes):
            for i in range(6):
                q_block[i * BATCH_SIZE + n] = q[first + n, i]
                dq_block[i * BATCH_SIZE + n] = dq[first + n, i]
        call(kinematics, (q_block, dq_block, frame_block, lanes))
        for n in range(lanes):
            for i in range(FRAME_SIZE):
                frames[first + n, i] = frame_block[i * BATCH_SIZE + n]


def random_states(arm, count=STATES, seed=1):
    rng = np.random.default_rng(seed)
    limits = np.array([(joint.lower, joint.upper) for joint in arm.free_joints])
    q = rng.uniform(*limits.T, (count, 6))
    return q, rng.uniform(-3.0, 3.0, (count, 6))


@pytest.fixture(params=ARMS, scope="module")
def case(request):
    """An arm, states, the record of each state, and what the held joint does to others' records."""
    arm, urdf = ARMS[request.param]
    q, dq = random_states(arm)
    frames = np.zeros((STATES, FRAME_SIZE))
    frames_of(addresses(arm)[0], q, dq, frames)
    return arm, urdf, q, dq, frames


def test_the_motion_is_the_same_bits_without_jacobian_and_bias(case):
    arm, _, q, dq, frames = case
    motions = np.full_like(frames, np.nan)
    frames_of(addresses(arm)[1], q, dq, motions)
    np.testing.assert_array_equal(motions[:, :J_DOT_DQ], frames[:, :J_DOT_DQ])
    assert not motions[:, J_DOT_DQ:].any()


@pytest.mark.parametrize("library", [pytest.param(Pinocchio, marks=pytest.mark.full), MuJoCo])
def test_pose_jacobian_and_bias_equal_those_of_an_independent_library(case, library):
    arm, urdf, q, dq, frames = case
    robot = library(urdf)
    free = [i for i in range(len(arm.joints)) if i + 1 != arm.held_joint]
    for q_i, dq_i, frame in zip(q, dq, frames, strict=True):
        dq_all = np.zeros(len(arm.joints))
        dq_all[free] = dq_i
        flange = robot.flange(arm.with_held(q_i), dq_all)
        J = flange.jacobian[:, free]
        assert frame[POSITION:ROTATION] == pytest.approx(flange.position, abs=TOLERANCE)
        assert frame[ROTATION:TWIST] == pytest.approx(flange.rotation.ravel(), abs=TOLERANCE)
        assert frame[TWIST:J_DOT_DQ] == pytest.approx(J @ dq_i, abs=TOLERANCE)
        assert frame[J_DOT_DQ:JACOBIAN] == pytest.approx(flange.bias, abs=TOLERANCE)
        assert frame[JACOBIAN:] == pytest.approx(J.ravel(), abs=TOLERANCE)


def test_python_and_compiled_kinematics_agree(case):
    arm, _, q, dq, frames = case
    for q_i, dq_i, frame in zip(q[:20], dq[:20], frames[:20], strict=True):
        parts = arm.kinematics(q_i, dq_i)
        assert frame == pytest.approx(np.concatenate([p.ravel() for p in parts]), abs=1e-13)


def test_the_wrist_centre_is_where_the_last_three_joints_leave_a_point():
    for name in ("iiwa7", "iiwa14"):
        arm = ARMS[name][0]
        wrist = wrist_centre(arm)
        assert wrist == pytest.approx([0.0, 0.0, -0.126], abs=1e-15)
        q, dq = random_states(arm, 50)
        dq[:, :3] = 0.0
        for q_i, dq_i in zip(q, dq, strict=True):
            flange = arm.kinematics(q_i, dq_i)
            at_wrist = flange.twist[:3] + np.cross(flange.twist[3:], flange.rotation @ wrist)
            assert at_wrist == pytest.approx(np.zeros(3), abs=1e-13)
    assert np.isnan(wrist_centre(ARMS["elbow6"][0])).all()
