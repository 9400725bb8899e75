"""Closed-loop inverse kinematics against NumPy, sampled linear theory and its own promises."""

import numpy as np
import pytest

from equipoise.control.clik import (
    ClikParameters,
    pose_error,
    solve,
)
from equipoise.model.arms.compiler import FRAME_SIZE, POSITION, ROTATION, TWIST
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import Settings
from equipoise.worlds.plant import (
    PHI,
    PHI_DOT,
    DomainRandomization,
    make_loop_params,
    new_batch_state,
    reset,
    step,
)

PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
NOMINAL = DomainRandomization(1.0, 1.0, 0.0, 1.0, 0.0)
ARMS = pytest.mark.parametrize("size", [7, 14])
SETTINGS = Settings()


def column(values, lane):
    """Return a block whose lane holds `values`, the other lanes zero."""
    block = np.zeros((len(values), BATCH_SIZE))
    block[:, lane] = values
    return block.ravel()


def parameters(wrist, w_0=1e-9, lambda_0=0.05):
    return ClikParameters(400.0, 40.0, w_0, lambda_0, tuple(float(c) for c in wrist))


def record(arm, q, dq, lane=0):
    frame = np.zeros(FRAME_SIZE * BATCH_SIZE)
    arm.compiled().kinematics(column(q, lane), column(dq, lane), frame, lane + 1)
    return frame


@ARMS
@pytest.mark.parametrize("lane", [0, 7, BATCH_SIZE - 1])
def test_both_solvers_equal_a_library_solver(size, lane):
    arm = iiwa(size)
    rng = np.random.default_rng(1)
    for _ in range(50):
        q, rhs = arm.home_free + rng.normal(0.0, 0.3, 6), rng.normal(size=6)
        frame = record(arm, q, np.zeros(6), lane)
        J = arm.kinematics(q).jacobian
        expected = np.linalg.solve(J, rhs)
        for wrist in (arm.compiled().wrist, np.full(3, np.nan)):
            y = np.zeros(6 * BATCH_SIZE)
            # Lanes below `lane` hold zeros, whose J is singular; they are damped, this one not.
            damped = solve(frame, column(rhs, lane), parameters(wrist), y, lane + 1)
            assert damped == lane
            # 1e-9: J J^T squares a condition number of up to 100 on roundings of 1e-16.
            np.testing.assert_allclose(y[lane::BATCH_SIZE], expected, rtol=1e-9, atol=1e-9)


def test_near_a_singularity_the_inverse_is_damped_least_squares_and_says_so():
    arm = iiwa(7)
    q = arm.home_free.copy()
    q[3 + 1] = 0.0  # the sixth joint at zero: axes five and seven fall together
    J = arm.kinematics(q).jacobian
    clik = parameters(arm.compiled().wrist, w_0=1e-3, lambda_0=0.1)
    w = abs(np.linalg.det(J))
    rhs = np.array([0.1, 0.0, 0.0, 0.3, 0.0, 0.2])
    y = np.zeros(6 * BATCH_SIZE)
    assert solve(record(arm, q, np.zeros(6)), column(rhs, 0), clik, y, 1) == 1
    damping = (0.1 * (1.0 - w / 1e-3)) ** 2
    expected = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), rhs)
    # 1e-5: where J J^T is singular to rounding, w is known to the root of the rounding only.
    np.testing.assert_allclose(y[::BATCH_SIZE], expected, rtol=1e-5, atol=1e-8)
    assert np.all(np.isfinite(y))


@ARMS
def test_a_disturbance_of_the_pose_decays_as_the_sampled_gains_say(size):
    arm = iiwa(size)
    h = 0.01
    plant = make_loop_params(arm, SETTINGS, h, PENDULUM)._replace(
        position_noise=0.0, orientation_noise=0.0
    )
    block = new_batch_state()
    reset(plant, block, PENDULUM, NOMINAL, (0.0, 0.0, 0.0, 0.0), 0)
    # Move the *reference* by 5 mm and 1 degree: the arm is off it by as much.
    block.controller.reference[(POSITION + 2) * BATCH_SIZE] += 0.005
    c, s = np.cos(np.radians(1.0)), np.sin(np.radians(1.0))
    R = block.controller.reference[ROTATION * BATCH_SIZE : TWIST * BATCH_SIZE : BATCH_SIZE].reshape(
        3, 3
    )
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    block.controller.reference[ROTATION * BATCH_SIZE : TWIST * BATCH_SIZE : BATCH_SIZE] = (
        turned.ravel()
    )
    # The sampled double integrator under u = K_p e + K_d e_dot, error and its rate.
    A = np.array([[1.0 - 400.0 * h**2 / 2.0, h - 40.0 * h**2 / 2.0], [-400.0 * h, 1.0 - 40.0 * h]])
    expected = np.array([1.0, 0.0])
    for _ in range(40):
        block.state[PHI * BATCH_SIZE] = block.state[PHI_DOT * BATCH_SIZE] = 0.0
        step(plant, block, 1)
        expected = A @ expected
        e = np.array(pose_error(block.controller.frame, block.controller.reference, 0))
        # 2 % of the disturbance: the arm's curvature over a step is not in the linear theory.
        np.testing.assert_allclose(e[2] / 0.005, expected[0], atol=0.02)
        np.testing.assert_allclose(e[5] / s, expected[0], atol=0.02)
    assert abs(e[2]) < 5e-5
