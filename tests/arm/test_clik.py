"""Closed-loop inverse kinematics against NumPy, sampled linear theory and its own promises."""

import numpy as np
import pytest

from equipoise.arm.chain import wrist_centre
from equipoise.arm.clik import ClikParameters, solve
from equipoise.arm.compiler import FRAME_SIZE, addresses
from equipoise.arm.iiwa import iiwa
from equipoise.control.control_step import kinematics
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import kernel

ARMS = pytest.mark.parametrize("size", [7, 14])


def column(values, lane):
    """Return a block whose lane holds `values`, the other lanes zero."""
    block = np.zeros((len(values), BATCH_SIZE))
    block[:, lane] = values
    return block


def parameters(wrist, w_0=1e-9, lambda_0=0.05):
    return ClikParameters(400.0, 40.0, w_0, lambda_0, tuple(float(c) for c in wrist))


def record(arm, q, dq, lane=0):
    frame = np.zeros((FRAME_SIZE, BATCH_SIZE))
    kinematics(addresses(arm)[0], column(q, lane), column(dq, lane), frame, lane + 1)
    return frame


@kernel
def solved(frame, rhs, parameters, y, lanes):
    """Solve in lanes, as kernels do it."""
    solve(frame, rhs, parameters, y, lanes)


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
        for wrist in (wrist_centre(arm), np.full(3, np.nan)):
            y = np.zeros((6, BATCH_SIZE))
            # Lanes below `lane` hold zeros, whose J is singular; they are damped, this one not.
            solved(frame, column(rhs, lane), parameters(wrist), y, lane + 1)
            # 1e-9: J J^T squares a condition number of up to 100 on roundings of 1e-16.
            np.testing.assert_allclose(y[:, lane], expected, rtol=1e-9, atol=1e-9)


def test_near_a_singularity_the_inverse_is_damped_least_squares():
    arm = iiwa(7)
    q = arm.home_free.copy()
    q[3 + 1] = 0.0  # the sixth joint at zero: axes five and seven fall together
    J = arm.kinematics(q).jacobian
    clik = parameters(wrist_centre(arm), w_0=1e-3, lambda_0=0.1)
    w = abs(np.linalg.det(J))
    rhs = np.array([0.1, 0.0, 0.0, 0.3, 0.0, 0.2])
    y = np.zeros((6, BATCH_SIZE))
    solved(record(arm, q, np.zeros(6)), column(rhs, 0), clik, y, 1)
    damping = (0.1 * (1.0 - w / 1e-3)) ** 2
    expected = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), rhs)
    # 1e-5: where J J^T is singular to rounding, w is known to the root of the rounding only.
    np.testing.assert_allclose(y[:, 0], expected, rtol=1e-5, atol=1e-8)
    assert np.all(np.isfinite(y))
