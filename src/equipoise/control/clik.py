r"""Second-order closed-loop inverse kinematics: the paper's equation (3).

.. math:: \ddot q = J^{-1} (\Gamma + K_d \dot e + K_p e - \dot J \dot q)

The flange follows a reference pose; e is the pose error (reference minus flange, position first,
then orientation as an angle-axis vector in base axes), e_dot the error of the twist. The reference
is a record like the arm's own: pose and twist in the same places, Gamma where that has J_dot dq. The loop is
closed on the *commanded* joint state, which is why no delay of a robot can make it unstable. K_p
and K_d are multiples of the identity, positive definite as the paper asks.

Near a singularity the inverse is damped (Nakamura & Hanafusa 1986): where the manipulability
w = \|det J\| is below w_0, J^{-1} becomes J^T (J J^T + lambda^2)^{-1} with
lambda = lambda_0 (1 - w/w_0), and the caller is told.
"""

from math import atan2, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.model.arms.arm import BIAS, JACOBIAN, POSITION, ROTATION, TWIST

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]
Twist = tuple[float, float, float, float, float, float]

GAMMA: Final = BIAS
REFERENCE_SIZE: Final = GAMMA + 6


class ClikParameters(NamedTuple):
    """Gains and damping of the loop."""

    K_p: float
    """Gain on the pose error [1/s^2]."""
    K_d: float
    """Gain on the twist error [1/s]."""
    w_0: float
    """Manipulability below which the inverse is damped [m^3]."""
    lambda_0: float
    """Damping at a singularity."""


@kernel
def pose_error(frame: Array, reference: Array) -> Twist:
    """Return the pose error, reference minus flange.

    Args:
        frame: Record of the arm's kinematics.
        reference: Record of where the flange shall be.

    Returns:
        Position [m] and angle-axis [rad] in base axes.
    """
    f, r, n = frame, reference, ROTATION
    # R_e = R_reference R^T; its skew part is sin(angle) * axis, its trace 1 + 2 cos(angle).
    sx, sy, sz, trace = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        sx += 0.5 * (r[n + 6 + i] * f[n + 3 + i] - r[n + 3 + i] * f[n + 6 + i])
        sy += 0.5 * (r[n + i] * f[n + 6 + i] - r[n + 6 + i] * f[n + i])
        sz += 0.5 * (r[n + 3 + i] * f[n + i] - r[n + i] * f[n + 3 + i])
        trace += r[n + i] * f[n + i] + r[n + 3 + i] * f[n + 3 + i] + r[n + 6 + i] * f[n + 6 + i]
    s2 = sx * sx + sy * sy + sz * sz
    if s2 < 1e-4 and trace > 1.0:
        scale = 1.0 + s2 / 6.0 + 3.0 * s2 * s2 / 40.0  # arcsin(s)/s, to 1e-13
    else:
        s = sqrt(s2)
        scale = atan2(s, 0.5 * (trace - 1.0)) / s if s > 0.0 else 0.0
    return (
        r[POSITION] - f[POSITION],
        r[POSITION + 1] - f[POSITION + 1],
        r[POSITION + 2] - f[POSITION + 2],
        scale * sx,
        scale * sy,
        scale * sz,
    )


@kernel
def joint_acceleration(
    frame: Array, reference: Array, e: Twist, parameters: ClikParameters, wrist: Point, ddq: Array
) -> bool:
    """Write the joint accelerations of equation (3) into `ddq`.

    Args:
        frame: Record of the arm's kinematics.
        reference: Record of where the flange shall be and how it shall accelerate.
        e: Pose error; the paper adds noise to it before it comes here.
        parameters: Gains and damping.
        wrist: Where the last three axes meet, in the flange frame [m]; NaN if they do not.
        ddq: Joint accelerations [rad/s^2], shape (6,).

    Returns:
        Whether the inverse had to be damped.
    """
    K_p, K_d = parameters.K_p, parameters.K_d
    r, f = reference, frame
    return solve(
        frame,
        (
            r[GAMMA] + K_d * (r[TWIST] - f[TWIST]) + K_p * e[0] - f[BIAS],
            r[GAMMA + 1] + K_d * (r[TWIST + 1] - f[TWIST + 1]) + K_p * e[1] - f[BIAS + 1],
            r[GAMMA + 2] + K_d * (r[TWIST + 2] - f[TWIST + 2]) + K_p * e[2] - f[BIAS + 2],
            r[GAMMA + 3] + K_d * (r[TWIST + 3] - f[TWIST + 3]) + K_p * e[3] - f[BIAS + 3],
            r[GAMMA + 4] + K_d * (r[TWIST + 4] - f[TWIST + 4]) + K_p * e[4] - f[BIAS + 4],
            r[GAMMA + 5] + K_d * (r[TWIST + 5] - f[TWIST + 5]) + K_p * e[5] - f[BIAS + 5],
        ),
        parameters,
        wrist,
        ddq,
    )


@kernel
def solve(
    frame: Array, rhs: Twist, parameters: ClikParameters, wrist: Point, solution: Array
) -> bool:
    """Solve J y = rhs, damped near singularities; return whether it was damped."""
    if wrist[0] == wrist[0] and _solve_at_wrist(frame, rhs, parameters.w_0, wrist, solution):
        return False
    return _solve_damped(frame, rhs, parameters, solution)


@kernel
def _solve_at_wrist(frame: Array, rhs: Twist, w_0: float, wrist: Point, y: Array) -> bool:
    """Solve J y = rhs where the last three axes meet: two systems of three equations.

    Seen from the wrist centre the last three joints do not move it, so J = [[A, 0], [B, C]] and
    |det J| = |det A| |det C|. Returns False, without a solution, where that is below w_0.
    """
    # From the flange to the wrist centre, in base axes.
    px = (
        frame[ROTATION] * wrist[0]
        + frame[ROTATION + 1] * wrist[1]
        + frame[ROTATION + 2] * wrist[2]
    )
    py = (
        frame[ROTATION + 3] * wrist[0]
        + frame[ROTATION + 4] * wrist[1]
        + frame[ROTATION + 5] * wrist[2]
    )
    pz = (
        frame[ROTATION + 6] * wrist[0]
        + frame[ROTATION + 7] * wrist[1]
        + frame[ROTATION + 8] * wrist[2]
    )
    linear, angular = JACOBIAN, JACOBIAN + 18
    # A: columns of the first three joints, moved to the wrist centre (v + omega x p).
    a00 = frame[linear] + frame[angular + 6] * pz - frame[angular + 12] * py
    a10 = frame[linear + 6] + frame[angular + 12] * px - frame[angular] * pz
    a20 = frame[linear + 12] + frame[angular] * py - frame[angular + 6] * px
    a01 = frame[linear + 1] + frame[angular + 7] * pz - frame[angular + 13] * py
    a11 = frame[linear + 7] + frame[angular + 13] * px - frame[angular + 1] * pz
    a21 = frame[linear + 13] + frame[angular + 1] * py - frame[angular + 7] * px
    a02 = frame[linear + 2] + frame[angular + 8] * pz - frame[angular + 14] * py
    a12 = frame[linear + 8] + frame[angular + 14] * px - frame[angular + 2] * pz
    a22 = frame[linear + 14] + frame[angular + 2] * py - frame[angular + 8] * px
    # C: axes of the last three joints.
    c00, c01, c02 = frame[angular + 3], frame[angular + 4], frame[angular + 5]
    c10, c11, c12 = frame[angular + 9], frame[angular + 10], frame[angular + 11]
    c20, c21, c22 = frame[angular + 15], frame[angular + 16], frame[angular + 17]
    # Cramer's rule: rows of the adjugates are cross products of columns.
    n00, n01, n02 = a11 * a22 - a21 * a12, a21 * a02 - a01 * a22, a01 * a12 - a11 * a02
    det_a = a00 * n00 + a10 * n01 + a20 * n02
    m00, m01, m02 = c11 * c22 - c21 * c12, c21 * c02 - c01 * c22, c01 * c12 - c11 * c02
    det_c = c00 * m00 + c10 * m01 + c20 * m02
    if abs(det_a * det_c) < w_0:
        return False
    n10, n11, n12 = a12 * a20 - a22 * a10, a22 * a00 - a02 * a20, a02 * a10 - a12 * a00
    n20, n21, n22 = a10 * a21 - a20 * a11, a20 * a01 - a00 * a21, a00 * a11 - a10 * a01
    bx = rhs[0] + rhs[4] * pz - rhs[5] * py
    by = rhs[1] + rhs[5] * px - rhs[3] * pz
    bz = rhs[2] + rhs[3] * py - rhs[4] * px
    over_a = 1.0 / det_a
    y0 = (n00 * bx + n01 * by + n02 * bz) * over_a
    y1 = (n10 * bx + n11 * by + n12 * bz) * over_a
    y2 = (n20 * bx + n21 * by + n22 * bz) * over_a
    m10, m11, m12 = c12 * c20 - c22 * c10, c22 * c00 - c02 * c20, c02 * c10 - c12 * c00
    m20, m21, m22 = c10 * c21 - c20 * c11, c20 * c01 - c00 * c21, c00 * c11 - c10 * c01
    wx = rhs[3] - frame[angular] * y0 - frame[angular + 1] * y1 - frame[angular + 2] * y2
    wy = rhs[4] - frame[angular + 6] * y0 - frame[angular + 7] * y1 - frame[angular + 8] * y2
    wz = rhs[5] - frame[angular + 12] * y0 - frame[angular + 13] * y1 - frame[angular + 14] * y2
    over_c = 1.0 / det_c
    y[0] = y0
    y[1] = y1
    y[2] = y2
    y[3] = (m00 * wx + m01 * wy + m02 * wz) * over_c
    y[4] = (m10 * wx + m11 * wy + m12 * wz) * over_c
    y[5] = (m20 * wx + m21 * wy + m22 * wz) * over_c
    return True


@kernel
def _solve_damped(frame: Array, rhs: Twist, parameters: ClikParameters, y: Array) -> bool:
    """Solve J J^T z = rhs, y = J^T z, with damping where |det J| < w_0; return whether damped."""
    damped = False
    damping = 0.0
    L = np.empty((6, 6))
    while True:
        w = _cholesky(frame, damping, L)
        if damped or w >= parameters.w_0:
            break
        damped = True
        damping = (parameters.lambda_0 * (1.0 - w / parameters.w_0)) ** 2
    z = np.empty(6)
    for i in range(6):
        z[i] = rhs[i]
        for k in range(i):
            z[i] -= L[i, k] * z[k]
        z[i] /= L[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            z[i] -= L[k, i] * z[k]
        z[i] /= L[i, i]
    for j in range(6):
        y[j] = 0.0
        for i in range(6):
            y[j] += frame[JACOBIAN + 6 * i + j] * z[i]
    return damped


@kernel
def _cholesky(frame: Array, damping: float, L: Array) -> float:
    """Factor J J^T + damping = L L^T and return the product of the diagonal of L.

    Without damping that product is the manipulability |det J|; where J J^T is singular to
    rounding it is zero, and L is not complete.
    """
    w = 1.0
    for i in range(6):
        for j in range(i + 1):
            s = damping if i == j else 0.0
            for k in range(6):
                s += frame[JACOBIAN + 6 * i + k] * frame[JACOBIAN + 6 * j + k]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = s / L[j, j]
            else:
                if s <= 0.0:
                    return 0.0
                L[i, i] = sqrt(s)
                w *= L[i, i]
    return w


@kernel
def manipulability(frame: Array) -> float:
    """Return |det J| [m^3]."""
    return _cholesky(frame, 0.0, np.empty((6, 6)))
