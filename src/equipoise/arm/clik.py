r"""Second-order closed-loop inverse kinematics: the paper's equation (3).

.. math:: \ddot q = J^{-1} (\Gamma + K_d \dot e + K_p e - \dot J \dot q)

The flange follows a reference; e is the pose error, reference minus flange: position, then
orientation as sin(angle) times the axis, in base axes (Siciliano 1990); e_dot is the error of the
twist. The reference is a record like the arm's own: pose and twist in the same rows, Gamma in place
of J_dot dq. The loop is closed on the *commanded* joint state, so that no delay of a robot can make
it unstable. K_p and K_d are multiples of the identity, positive definite as the
paper asks.

Near a singularity the inverse is damped (Nakamura & Hanafusa 1986): where the manipulability
w = \|det J\| is below w_0, J^{-1} becomes J^T (J J^T + lambda^2)^{-1} with
lambda = lambda_0 (1 - w/w_0).

Records are blocks of lanes, see `equipoise.elementary`.
"""

from math import isnan, sqrt
from typing import Final, NamedTuple

import numpy as np

from equipoise.arm.chain import Triple
from equipoise.arm.compiler import J_DOT_DQ, JACOBIAN, POSITION, ROTATION, TWIST
from equipoise.arrays import Array
from equipoise.elementary import BATCH_SIZE, fma
from equipoise.jit import compilable, inlined

Twist = tuple[float, float, float, float, float, float]

GAMMA: Final = J_DOT_DQ
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
    wrist: Triple
    """Intersection of the last three axes, in the flange frame [m]; NaN if they do not meet."""


@inlined
def pose_error(frame: Array, reference: Array, n: int) -> Twist:
    """Return the pose error of lane `n`, reference minus flange.

    Args:
        frame: Record of the arm's kinematics.
        reference: Record of the reference.
        n: Lane.

    Returns:
        Position [m], and sin(angle) times the axis of the remaining rotation, in base axes.
    """
    # The skew part of R_reference R^T, a sum over the columns of both.
    sx, sy, sz = 0.0, 0.0, 0.0
    for i in range(ROTATION, ROTATION + 3):
        r0, r1, r2 = reference[i, n], reference[i + 3, n], reference[i + 6, n]
        f0, f1, f2 = frame[i, n], frame[i + 3, n], frame[i + 6, n]
        sx = fma(r2, f1, fma(-r1, f2, sx))
        sy = fma(r0, f2, fma(-r2, f0, sy))
        sz = fma(r1, f0, fma(-r0, f1, sz))
    return (
        reference[POSITION, n] - frame[POSITION, n],
        reference[POSITION + 1, n] - frame[POSITION + 1, n],
        reference[POSITION + 2, n] - frame[POSITION + 2, n],
        0.5 * sx,
        0.5 * sy,
        0.5 * sz,
    )


@inlined
def joint_acceleration(
    frame: Array, reference: Array, e: Array, parameters: ClikParameters, ddq: Array, lanes: int
) -> None:
    """Write the joint accelerations of equation (3) into `ddq`.

    Args:
        frame: Record of the arm's kinematics.
        reference: Record of the reference, with its acceleration Gamma.
        e: Pose error, with the paper's noise, 6 rows; overwritten.
        parameters: Gains and damping.
        ddq: Joint accelerations [rad/s^2], 6 rows.
        lanes: Number of lanes.
    """
    for i in range(6):
        for n in range(BATCH_SIZE):
            e_dot = reference[TWIST + i, n] - frame[TWIST + i, n]
            wanted = reference[GAMMA + i, n] - frame[J_DOT_DQ + i, n]
            e[i, n] = fma(parameters.K_p, e[i, n], fma(parameters.K_d, e_dot, wanted))
    solve(frame, e, parameters, ddq, lanes)


@inlined
def solve(frame: Array, rhs: Array, parameters: ClikParameters, y: Array, lanes: int) -> None:
    """Solve J y = rhs in each lane, damped near singularities."""
    wrist, w_0 = parameters.wrist, parameters.w_0
    if isnan(wrist[0]):  # the last three axes do not meet
        for n in range(lanes):
            _solve_damped(frame, rhs, parameters, y, n)
        return
    near_singular = 0
    for n in range(BATCH_SIZE):
        w = _solve_at_wrist(frame, rhs, wrist, y, n)
        near_singular += (w < w_0) & (n < lanes)
    if near_singular > 0:
        for n in range(lanes):
            if _solve_at_wrist(frame, rhs, wrist, y, n) < w_0:
                _solve_damped(frame, rhs, parameters, y, n)


@inlined
def _solve_at_wrist(frame: Array, rhs: Array, wrist: Triple, y: Array, n: int) -> float:
    """Solve J y = rhs where the last three axes meet, and return the manipulability.

    The last three joints do not move the wrist centre, so J = [[A, 0], [B, C]] there, and
    |det J| = |det A| |det C|: two systems of three equations, by Cramer's rule.
    """
    # From the flange to the wrist centre, in base axes.
    r = ROTATION
    p = (
        dot((frame[r, n], frame[r + 1, n], frame[r + 2, n]), wrist),
        dot((frame[r + 3, n], frame[r + 4, n], frame[r + 5, n]), wrist),
        dot((frame[r + 6, n], frame[r + 7, n], frame[r + 8, n]), wrist),
    )
    # B: axes of the first three joints, by columns; A: velocities that they give the wrist centre.
    b0, b1 = _axis(frame, ANGULAR, n), _axis(frame, ANGULAR + 1, n)
    b2 = _axis(frame, ANGULAR + 2, n)
    a0 = _velocity_at(p, _axis(frame, JACOBIAN, n), b0)
    a1 = _velocity_at(p, _axis(frame, JACOBIAN + 1, n), b1)
    a2 = _velocity_at(p, _axis(frame, JACOBIAN + 2, n), b2)
    # The right-hand side, moved in the same way.
    g3, g4, g5 = rhs[3, n], rhs[4, n], rhs[5, n]
    g = _velocity_at(p, (rhs[0, n], rhs[1, n], rhs[2, n]), (g3, g4, g5))
    y0, y1, y2, det_a = _cramer(a0, a1, a2, g)
    first = y0, y1, y2
    g3 -= dot((b0[0], b1[0], b2[0]), first)
    g4 -= dot((b0[1], b1[1], b2[1]), first)
    g5 -= dot((b0[2], b1[2], b2[2]), first)
    # C: axes of the last three joints.
    c0, c1 = _axis(frame, ANGULAR + 3, n), _axis(frame, ANGULAR + 4, n)
    c2 = _axis(frame, ANGULAR + 5, n)
    y3, y4, y5, det_c = _cramer(c0, c1, c2, (g3, g4, g5))
    y[0, n] = y0
    y[1, n] = y1
    y[2, n] = y2
    y[3, n] = y3
    y[4, n] = y4
    y[5, n] = y5
    return abs(det_a * det_c)


@inlined
def _axis(frame: Array, row: int, n: int) -> Triple:
    """Return half a column of J in lane `n`, from its first row in the record."""
    return frame[row, n], frame[row + 6, n], frame[row + 12, n]


@inlined
def _velocity_at(p: Triple, v: Triple, omega: Triple) -> Triple:
    """Return the velocity v + omega x p of a point at p from one with velocity v."""
    return (
        fma(-omega[2], p[1], fma(omega[1], p[2], v[0])),
        fma(-omega[0], p[2], fma(omega[2], p[0], v[1])),
        fma(-omega[1], p[0], fma(omega[0], p[1], v[2])),
    )


@inlined
def _cramer(a: Triple, b: Triple, c: Triple, g: Triple) -> tuple[float, float, float, float]:
    """Solve x a + y b + z c = g; return x, y, z (zero if there is no solution), determinant."""
    # Rows of the adjugate are cross products of the columns.
    n0, n1, n2 = _cross(b, c), _cross(c, a), _cross(a, b)
    det = dot(a, n0)
    scale = 1.0 / (det if det != 0.0 else np.inf)
    return dot(n0, g) * scale, dot(n1, g) * scale, dot(n2, g) * scale, det


@inlined
def _cross(a: Triple, b: Triple) -> Triple:
    return (
        fma(a[1], b[2], -(a[2] * b[1])),
        fma(a[2], b[0], -(a[0] * b[2])),
        fma(a[0], b[1], -(a[1] * b[0])),
    )


@inlined
def dot(a: Triple, b: Triple) -> float:
    """Return the product a . b."""
    return fma(a[2], b[2], fma(a[1], b[1], a[0] * b[0]))


@compilable
def _solve_damped(frame: Array, rhs: Array, parameters: ClikParameters, y: Array, n: int) -> None:
    """Solve J J^T z = rhs, y = J^T z in lane `n`, damped near a singularity."""
    L = np.empty((6, 6))
    w = _cholesky(frame, 0.0, L, n)
    if w < parameters.w_0:
        _cholesky(frame, (parameters.lambda_0 * (1.0 - w / parameters.w_0)) ** 2, L, n)
    z = np.empty(6)
    for i in range(6):
        z[i] = rhs[i, n]
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
            sum_j += frame[JACOBIAN + 6 * i + j, n] * z[i]
        y[j, n] = sum_j


@compilable
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
                s += frame[JACOBIAN + 6 * i + k, n] * frame[JACOBIAN + 6 * j + k, n]
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


@compilable
def manipulability(frame: Array, n: int) -> float:
    """Return |det J| of lane `n` [m^3]."""
    return _cholesky(frame, 0.0, np.empty((6, 6)), n)
