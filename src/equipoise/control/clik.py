r"""Second-order closed-loop inverse kinematics: the paper's equation (3).

.. math:: \ddot q = J^{-1} (\Gamma + K_d \dot e + K_p e - \dot J \dot q)

The flange follows a reference; e is the pose error, reference minus flange: position, then
orientation as sin(angle) times the axis, in base axes (Siciliano 1990); e_dot is the error of the
twist. The reference is a record like the arm's own: pose and twist in the same rows, Gamma where
that has J_dot dq. The loop is closed on the *commanded* joint state, which is why no delay of a
robot can make it unstable. K_p and K_d are multiples of the identity, positive definite as the
paper asks.

Near a singularity the inverse is damped (Nakamura & Hanafusa 1986): where the manipulability
w = \|det J\| is below w_0, J^{-1} becomes J^T (J J^T + lambda^2)^{-1} with
lambda = lambda_0 (1 - w/w_0), and the caller is told.

Records are blocks of lanes, see `equipoise.model.elementary`.
"""

from math import sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import inlined, kernel
from equipoise.model.arms.arm import BIAS, JACOBIAN, POSITION, ROTATION, TWIST
from equipoise.model.elementary import at, put

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]
Twist = tuple[float, float, float, float, float, float]

GAMMA: Final = BIAS
REFERENCE_SIZE: Final = GAMMA + 6
"""Rows of a reference."""
ANGULAR: Final = JACOBIAN + 18
"""First row of the angular half of J."""


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
    wrist: Point
    """Where the last three axes meet, in the flange frame [m]; NaN if they do not."""


@inlined
def pose_error(frame: Array, reference: Array, n: int) -> Twist:
    """Return the pose error of lane `n`, reference minus flange.

    Args:
        frame: Record of the arm's kinematics.
        reference: Record of where the flange shall be.
        n: Lane.

    Returns:
        Position [m], and sin(angle) times the axis of the rotation that is left, in base axes.
    """
    # The skew part of R_reference R^T, a sum over the columns of both.
    sx, sy, sz = 0.0, 0.0, 0.0
    for i in range(ROTATION, ROTATION + 3):
        r0, r1, r2 = at(reference, i, n), at(reference, i + 3, n), at(reference, i + 6, n)
        f0, f1, f2 = at(frame, i, n), at(frame, i + 3, n), at(frame, i + 6, n)
        sx += 0.5 * (r2 * f1 - r1 * f2)
        sy += 0.5 * (r0 * f2 - r2 * f0)
        sz += 0.5 * (r1 * f0 - r0 * f1)
    return (
        at(reference, POSITION, n) - at(frame, POSITION, n),
        at(reference, POSITION + 1, n) - at(frame, POSITION + 1, n),
        at(reference, POSITION + 2, n) - at(frame, POSITION + 2, n),
        sx,
        sy,
        sz,
    )


@kernel
def joint_acceleration(
    frame: Array, reference: Array, e: Array, parameters: ClikParameters, ddq: Array, lanes: int
) -> int:
    """Write the joint accelerations of equation (3) into `ddq`.

    Args:
        frame: Record of the arm's kinematics.
        reference: Record of where the flange shall be and how it shall accelerate.
        e: Pose error, a block of 6 rows; the paper adds noise to it before it comes here.
            Overwritten.
        parameters: Gains and damping.
        ddq: Joint accelerations [rad/s^2], a block of 6 rows.
        lanes: How many lanes.

    Returns:
        In how many lanes the inverse had to be damped.
    """
    for i in range(6):
        for n in range(lanes):
            e_dot = at(reference, TWIST + i, n) - at(frame, TWIST + i, n)
            feedback = parameters.K_d * e_dot + parameters.K_p * at(e, i, n)
            put(e, i, n, at(reference, GAMMA + i, n) + feedback - at(frame, BIAS + i, n))
    return solve(frame, e, parameters, ddq, lanes)


@kernel
def solve(frame: Array, rhs: Array, parameters: ClikParameters, y: Array, lanes: int) -> int:
    """Solve J y = rhs in each lane, damped near singularities; return how often it was damped."""
    wrist, w_0 = parameters.wrist, parameters.w_0
    damped = 0
    if wrist[0] != wrist[0]:
        for n in range(lanes):
            damped += _solve_damped(frame, rhs, parameters, y, n)
        return damped
    near_singular = 0
    for n in range(lanes):
        near_singular += 1 if _solve_at_wrist(frame, rhs, wrist, y, n) < w_0 else 0
    if near_singular > 0:
        for n in range(lanes):
            if _solve_at_wrist(frame, rhs, wrist, y, n) < w_0:
                damped += _solve_damped(frame, rhs, parameters, y, n)
    return damped


@inlined
def _solve_at_wrist(frame: Array, rhs: Array, wrist: Point, y: Array, n: int) -> float:
    """Solve J y = rhs where the last three axes meet, and return the manipulability.

    Seen from the wrist centre the last three joints do not move it, so J = [[A, 0], [B, C]] and
    |det J| = |det A| |det C|: two systems of three equations, by Cramer's rule.
    """
    # From the flange to the wrist centre, in base axes.
    wx, wy, wz = wrist
    r = ROTATION
    px = at(frame, r, n) * wx + at(frame, r + 1, n) * wy + at(frame, r + 2, n) * wz
    py = at(frame, r + 3, n) * wx + at(frame, r + 4, n) * wy + at(frame, r + 5, n) * wz
    pz = at(frame, r + 6, n) * wx + at(frame, r + 7, n) * wy + at(frame, r + 8, n) * wz
    # B: axes of the first three joints; C: axes of the last three.
    b00, b01, b02 = at(frame, ANGULAR, n), at(frame, ANGULAR + 1, n), at(frame, ANGULAR + 2, n)
    b10, b11, b12 = at(frame, ANGULAR + 6, n), at(frame, ANGULAR + 7, n), at(frame, ANGULAR + 8, n)
    b20, b21, b22 = (
        at(frame, ANGULAR + 12, n),
        at(frame, ANGULAR + 13, n),
        at(frame, ANGULAR + 14, n),
    )
    c00, c01, c02 = at(frame, ANGULAR + 3, n), at(frame, ANGULAR + 4, n), at(frame, ANGULAR + 5, n)
    c10, c11, c12 = (
        at(frame, ANGULAR + 9, n),
        at(frame, ANGULAR + 10, n),
        at(frame, ANGULAR + 11, n),
    )
    c20, c21, c22 = (
        at(frame, ANGULAR + 15, n),
        at(frame, ANGULAR + 16, n),
        at(frame, ANGULAR + 17, n),
    )
    # A: what the first three joints do to the wrist centre, v + omega x p.
    j = JACOBIAN
    a00 = at(frame, j, n) + b10 * pz - b20 * py
    a10 = at(frame, j + 6, n) + b20 * px - b00 * pz
    a20 = at(frame, j + 12, n) + b00 * py - b10 * px
    a01 = at(frame, j + 1, n) + b11 * pz - b21 * py
    a11 = at(frame, j + 7, n) + b21 * px - b01 * pz
    a21 = at(frame, j + 13, n) + b01 * py - b11 * px
    a02 = at(frame, j + 2, n) + b12 * pz - b22 * py
    a12 = at(frame, j + 8, n) + b22 * px - b02 * pz
    a22 = at(frame, j + 14, n) + b02 * py - b12 * px
    # The right-hand side, moved in the same way.
    g3, g4, g5 = at(rhs, 3, n), at(rhs, 4, n), at(rhs, 5, n)
    g0 = at(rhs, 0, n) + g4 * pz - g5 * py
    g1 = at(rhs, 1, n) + g5 * px - g3 * pz
    g2 = at(rhs, 2, n) + g3 * py - g4 * px
    y0, y1, y2, det_a = _cramer(a00, a01, a02, a10, a11, a12, a20, a21, a22, g0, g1, g2)
    g3 -= b00 * y0 + b01 * y1 + b02 * y2
    g4 -= b10 * y0 + b11 * y1 + b12 * y2
    g5 -= b20 * y0 + b21 * y1 + b22 * y2
    y3, y4, y5, det_c = _cramer(c00, c01, c02, c10, c11, c12, c20, c21, c22, g3, g4, g5)
    put(y, 0, n, y0)
    put(y, 1, n, y1)
    put(y, 2, n, y2)
    put(y, 3, n, y3)
    put(y, 4, n, y4)
    put(y, 5, n, y5)
    return abs(det_a * det_c)


@inlined
def _cramer(
    a00: float,
    a01: float,
    a02: float,
    a10: float,
    a11: float,
    a12: float,
    a20: float,
    a21: float,
    a22: float,
    g0: float,
    g1: float,
    g2: float,
) -> tuple[float, float, float, float]:
    """Solve three equations; return the solution (zero if there is none) and the determinant."""
    # Rows of the adjugate are cross products of the columns.
    n00, n01, n02 = a11 * a22 - a21 * a12, a21 * a02 - a01 * a22, a01 * a12 - a11 * a02
    n10, n11, n12 = a12 * a20 - a22 * a10, a22 * a00 - a02 * a20, a02 * a10 - a12 * a00
    n20, n21, n22 = a10 * a21 - a20 * a11, a20 * a01 - a00 * a21, a00 * a11 - a10 * a01
    det = a00 * n00 + a10 * n01 + a20 * n02
    scale = 1.0 / (det if det != 0.0 else np.inf)
    return (
        (n00 * g0 + n01 * g1 + n02 * g2) * scale,
        (n10 * g0 + n11 * g1 + n12 * g2) * scale,
        (n20 * g0 + n21 * g1 + n22 * g2) * scale,
        det,
    )


@kernel
def _solve_damped(frame: Array, rhs: Array, parameters: ClikParameters, y: Array, n: int) -> int:
    """Solve J J^T z = rhs, y = J^T z in lane `n`; return 1 where it had to be damped, else 0."""
    damped = 0
    L = np.empty((6, 6))
    w = _cholesky(frame, 0.0, L, n)
    if w < parameters.w_0:
        damped = 1
        _cholesky(frame, (parameters.lambda_0 * (1.0 - w / parameters.w_0)) ** 2, L, n)
    z = np.empty(6)
    for i in range(6):
        z[i] = at(rhs, i, n)
        for k in range(i):
            z[i] -= L[i, k] * z[k]
        z[i] /= L[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            z[i] -= L[k, i] * z[k]
        z[i] /= L[i, i]
    for j in range(6):
        sum_j = 0.0
        for i in range(6):
            sum_j += at(frame, JACOBIAN + 6 * i + j, n) * z[i]
        put(y, j, n, sum_j)
    return damped


@kernel
def _cholesky(frame: Array, damping: float, L: Array, n: int) -> float:
    """Factor J J^T + damping = L L^T and return the product of the diagonal of L.

    Without damping that product is the manipulability |det J|; where J J^T is singular to
    rounding it is zero, and L is not complete.
    """
    w = 1.0
    for i in range(6):
        for j in range(i + 1):
            s = damping if i == j else 0.0
            for k in range(6):
                s += at(frame, JACOBIAN + 6 * i + k, n) * at(frame, JACOBIAN + 6 * j + k, n)
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
def manipulability(frame: Array, n: int) -> float:
    """Return |det J| of lane `n` [m^3]."""
    return _cholesky(frame, 0.0, np.empty((6, 6)), n)
