r"""Recoverable set: releases of the pendulum that some controller can balance.

Near upright the pendulum of `equipoise.model.pendulum` has the roots :math:`\lambda` and
:math:`-\mu` of :math:`s^2 + c s - w_2`. With friction f the diverging angle obeys

.. math:: \zeta = \varphi + \dot\varphi / \mu, \qquad
    \dot\zeta = \lambda \zeta - (k u + f\,\mathrm{sign}\,\dot\varphi) / \mu

No acceleration up to :math:`u_{max}` turns it back beyond :math:`(k u_{max} + f) / w_2`, about
:math:`u_{max} / g` for every pendulum. During the delay T of the arm it grows by
:math:`e^{\lambda T}`. Failure angle and track make the set smaller: the flange must also stop
before its end.

The arm is modelled as a delay T, after which it accelerates with :math:`|u| \le u_{max}`, held for
a tick. Two sets enclose the recoverable one, both by linear programs over the ticks:

- *necessary*: a convex set. The linear pendulum receives an additional acceleration up to the
  largest that sine, cosine, dry friction and drag can add within the failure angle, in its favour.
  No controller recovers a release outside.
- *sufficient*: for each direction the largest release from which an explicit command brings the
  nonlinear pendulum and the flange to rest within all limits, by sequential linear programming.
  Dry friction is left out.
"""

from math import ceil, cos, degrees, exp, inf, log, sin, sqrt
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.sparse import block_array, block_diag, csr_array, eye_array
from scipy.special import ndtri

from equipoise import paper
from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.control.grid import PHI_LIMIT
from equipoise.errors import SettingsError
from equipoise.model.actuator import CYCLE, Actuator, follow, lag_share
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.pendulum import PendulumParameters, step
from equipoise.settings import Settings
from equipoise.worlds.plant import MIN_INERTIA_FACTOR, scaled

Array = npt.NDArray[np.float64]

TIME_CONSTANTS: Final = 10.0
"""Length of a recovery in time constants of the fall: twice as long changes the set by less than
0.1 %."""
MAX_TICKS: Final = 400
"""Limit on the ticks of a recovery; both sets stay valid for a slower fall."""
MAX_GROWTH: Final = 10.0
"""Growth of the fall within a tick, in powers of e, beyond which the track has no effect."""
MAX_RATE: Final = 200.0
"""Limit on lambda for the delay of the arm [1/s]: faster falls see the transport alone."""
RESPONSE_TIME: Final = 0.3
"""Simulated time of the arm's response to constant acceleration [s]; it follows within 0.1 s."""
DIRECTIONS: Final = 48
"""Number of directions of a boundary."""
FALL_STEPS: Final = (4, 1000)
"""Smallest and largest number of Runge-Kutta steps over the delay."""
FALL_STEP: Final = 0.1
"""Length of these steps in time constants of the fall."""
ITERATIONS: Final = 8
"""Maximum number of linear programs for a direction of the sufficient set."""
DEFECT: Final = 1e-7
"""Largest accepted defect of a trajectory of the sufficient set, per tick [rad], [rad/s]."""
CLOSE: Final = 0.75
"""Diverging angle of the worst release, as a share of its limit, above which a warning is given:
along a release the shipped table holds starts up to 0.58 of the limit, LQR up to 0.86."""
RELEASES: Final = 1000
"""Number of releases for the share that is recoverable."""
PENDULUM_PLANE: Final = ((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
FLANGE_PLANE: Final = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))
"""Axes of slices of the recoverable set: (phi, phi_dot) and (x, x_dot)."""


class RecoveryParams(NamedTuple):
    """Parameters of a recovery."""

    pendulum: PendulumParameters
    """The pendulum."""
    delay: float
    """T, from the release to the acceleration of the flange [s]."""
    u_max: float = paper.U_MAX
    """Largest acceleration of the flange [m/s^2]."""
    phi_limit: float = PHI_LIMIT
    """Failure angle [rad]."""
    x_limit: float = paper.X_LIMIT
    """Failure displacement of the flange [m]."""
    speed_limit: float = inf
    """Failure speed of the flange [m/s]."""
    h: float = paper.STEP
    """Length of a tick [s]."""

    @property
    def rate(self) -> float:
        """Rate of the fall, lambda [1/s]."""
        return fall_rate(self.pendulum)

    @property
    def fade(self) -> float:
        """Rate of the converging motion, mu [1/s]."""
        return self.rate + self.pendulum.c

    @property
    def largest(self) -> float:
        """Largest diverging angle that an endless track would allow, after the delay [rad]."""
        w2, k, _, f = self.pendulum[:4]
        return (k * self.u_max + f) / w2


def fall_rate(pendulum: PendulumParameters) -> float:
    """Return the rate at which the pendulum falls, the root lambda [1/s]."""
    return 0.5 * (sqrt(pendulum.c**2 + 4.0 * pendulum.w2) - pendulum.c)


def diverging_angle(phi: Any, phi_dot: Any, pendulum: PendulumParameters) -> Any:
    """Return the diverging angle phi + phi_dot / mu [rad].

    Args:
        phi: Angle from upright [rad], a number or an array.
        phi_dot: Angular velocity [rad/s].
        pendulum: The pendulum.
    """
    return phi + phi_dot / (fall_rate(pendulum) + pendulum.c)


def make_recovery_params(
    pendulum: PendulumParameters, arm: Arm, settings: Settings, actuator: Actuator
) -> RecoveryParams:
    """Return the parameters of a recovery.

    Args:
        pendulum: The pendulum.
        arm: The arm with its home posture.
        settings: The section `plant`.
        actuator: Model of the arm's response.
    """
    max_speed = settings.plant.max_speed
    return RecoveryParams(
        pendulum,
        response_delay(arm, actuator, fall_rate(pendulum)),
        speed_limit=inf if max_speed is None else max_speed,
    )


def response_delay(arm: Arm, actuator: Actuator, rate: float, u_max: float = paper.U_MAX) -> float:
    r"""Return the delay T of an arm that accelerates from rest with all its acceleration [s].

    The pure delay with the same effect on the fall:
    :math:`e^{-\lambda T} = \lambda^2 \int e^{-\lambda t} v(t) dt / u_{max}`, where v is the
    pivot's velocity behind transport, servo and drive. It is shorter than the prediction
    horizon (`equipoise.control.control_step.horizon`), which holds for slow motion and has a
    margin.

    Args:
        arm: The arm with its home posture.
        actuator: Model of the arm's response.
        rate: lambda [1/s].
        u_max: Acceleration [m/s^2].
    """
    if actuator.kind == "ideal":
        return 0.0
    rate = min(rate, MAX_RATE)
    home = arm.kinematics(arm.home_free)
    _, lever_y, lever_z = home.rotation @ np.array(arm.pivot)
    along_x = np.linalg.solve(home.jacobian, np.eye(FREE_JOINTS)[0])
    of_pivot = home.jacobian[0] + lever_z * home.jacobian[4] - lever_y * home.jacobian[5]
    q, dq, target = (np.zeros(FREE_JOINTS * BATCH_SIZE) for _ in range(3))
    share = np.repeat([float(lag_share(lag.value)) for lag in actuator.lags], BATCH_SIZE)
    interval = round(paper.STEP / SETPOINTS_PER_TICK / CYCLE)
    late, cycles = round(actuator.delay.value / CYCLE), round(RESPONSE_TIME / CYCLE)
    v = np.zeros(cycles)
    for cycle in range(cycles):
        # A setpoint is the place of the reference at the end of its interval.
        sent = max((cycle - late) // interval + 1, 0) * interval * CYCLE
        target[::BATCH_SIZE] = 0.5 * u_max * sent**2 * along_x
        follow(q, dq, target, share, actuator.parameters, 1)
        v[cycle] = of_pivot @ dq[::BATCH_SIZE]
    # By parts, with the mean of the last interval and full acceleration from there on.
    weights = np.diff(-np.exp(-rate * CYCLE * np.arange(cycles + 1)))
    last = float(np.mean(v[-interval:])) + u_max / rate
    effect = float(weights @ v) + exp(-rate * cycles * CYCLE) * last
    return -log(rate * effect / u_max) / rate


def fall(params: RecoveryParams, states: Array, delay: float | None = None) -> Array:
    """Return the states after the delay, during which the flange keeps its velocity.

    A pendulum that reaches the failure angle stays there.

    Args:
        params: Parameters.
        states: x [m], x_dot [m/s], phi [rad], phi_dot [rad/s], shape (n, 4).
        delay: Time [s], by default T; negative for the states before.
    """
    time = params.delay if delay is None else delay
    low, high = FALL_STEPS
    steps = max(low, min(high, ceil(abs(time) * params.rate / FALL_STEP)))
    after = np.array(states, np.float64)
    if time == 0.0:
        return after
    after[:, 0] += time * after[:, 1]
    for row in after:
        phi, phi_dot = float(row[2]), float(row[3])
        for _ in range(steps):
            if time > 0.0 and abs(phi) > params.phi_limit:
                break
            phi, phi_dot = step(phi, phi_dot, 0.0, time / steps, params.pendulum)
        row[2:] = phi, phi_dot
    return after


def largest_start(params: RecoveryParams, direction: Array) -> float:
    """Return the factor on a state up to which it may be recoverable, after the delay.

    Args:
        params: Parameters.
        direction: x [m], x_dot [m/s], phi [rad], phi_dot [rad/s], shape (4,).
    """
    if params.rate * params.h > MAX_GROWTH:
        angle = diverging_angle(direction[2], direction[3], params.pendulum)
        return float(abs(params.largest / angle))
    A, b = _linear(params)
    N = _ticks(params)
    return _solve(params, direction, [A] * N, [b] * N, helps=_help(params))[0]


def largest_recovery(params: RecoveryParams, direction: Array) -> tuple[float, Array]:
    """Return the factor up to which a state is recovered, and the commands that do it.

    Args:
        params: Parameters.
        direction: x [m], x_dot [m/s], phi [rad], phi_dot [rad/s], shape (4,).

    Returns:
        The factor, 0 if no trajectory was found, and u at each tick [m/s^2], shape (n,).
    """
    A, b = _linear(params)
    N = _ticks(params)
    As, bs, rest = [A] * N, [b] * N, np.zeros((N, 4))
    for _ in range(ITERATIONS):
        factor, u, states = _solve(params, direction, As, bs, rest=rest)
        start = np.vstack((factor * direction, states[:-1]))
        next_states, As, bs = _linearised(params, start, u)
        defect = float(np.max(np.abs(next_states - states)))
        if defect < DEFECT:
            return factor, u
        pairs = zip(next_states, As, bs, start, u, strict=True)
        rest = np.array([after - A @ s - b * a for after, A, b, s, a in pairs])
    return 0.0, np.zeros(N)


class ReleaseLimit(NamedTuple):
    """Releases of a task, compared with the recoverable set."""

    share: float
    """Share of the releases inside the necessary set."""
    delay: float
    """Delay T of the arm [s]."""
    gentlest: float
    """Smallest diverging angle of the releases, after the delay [rad]."""
    worst: float
    """Largest diverging angle of the releases, after the delay [rad]."""
    limit: float
    """Diverging angle up to which the worst release may be recoverable, after the delay [rad]."""

    @property
    def use(self) -> float:
        """Diverging angle of the worst release as a share of its limit."""
        return self.worst / self.limit


def release_limit(
    pendulum: PendulumParameters, arm: Arm, settings: Settings, actuator: Actuator
) -> ReleaseLimit:
    """Compare the releases of a task with the necessary set.

    Angles and rates vary as in trials, with the plant: inertia, transport delay and lag. An unknown
    zero error of the encoder only makes a recovery harder; it is left out.

    Args:
        pendulum: The pendulum.
        arm: The arm with its home posture.
        settings: Releases (`evaluation`) and variation of the plant (`plant`).
        actuator: Model of the arm's response.
    """
    params = make_recovery_params(pendulum, arm, settings, actuator)
    e, plant = settings.evaluation, settings.plant
    draws = np.random.default_rng(0).random((RELEASES, 5))
    phi = e.phi_low + (e.phi_high - e.phi_low) * draws[:, 0]
    phi_dot = e.phi_dot_low + (e.phi_dot_high - e.phi_dot_low) * draws[:, 1]
    inertia = np.maximum(1.0 + plant.inertia_sigma * ndtri(draws[:, 2]), MIN_INERTIA_FACTOR)
    delay = np.full(RELEASES, params.delay)
    if actuator.kind != "ideal":
        lag = float(np.mean([one.value for one in actuator.lags]))
        delay += plant.delay_spread * (2.0 * draws[:, 3] - 1.0)
        delay += lag * plant.lag_spread * (2.0 * draws[:, 4] - 1.0)
    states = np.zeros((RELEASES, 4))
    for i, state in enumerate(states):
        one = params._replace(pendulum=scaled(pendulum, float(inertia[i]), 1.0))
        state[:] = fall(one, np.array([[0.0, 0.0, phi[i], phi_dot[i]]]), max(delay[i], 0.0))
    angles = diverging_angle(states[:, 2], states[:, 3], pendulum)
    worst = int(np.argmax(angles))
    factor, share = largest_start(params, states[worst]), 1.0
    if params.rate * params.h > MAX_GROWTH:
        share = float(np.mean(angles <= params.largest))
    elif factor < 1.0:
        share = float(np.mean(boundary(params).share(states[:, 2:]) <= 1.0))
    return ReleaseLimit(
        share,
        params.delay,
        float(angles.min()),
        float(angles[worst]),
        factor * float(angles[worst]),
    )


def check_releases(
    pendulum: PendulumParameters,
    arm: Arm,
    settings: Settings,
    actuator: Actuator,
    least: float = 0.0,
) -> str | None:
    """Reject a task whose releases no controller recovers.

    Args:
        pendulum: The pendulum.
        arm: The arm with its home posture.
        settings: Releases (`evaluation`) and variation of the plant (`plant`).
        actuator: Model of the arm's response.
        least: Required share of the releases that may be recoverable.

    Returns:
        A warning if a part of the releases is lost, or the worst is close to the limit, else None.

    Raises:
        SettingsError: All releases are lost, or more than allowed.
    """
    found = release_limit(pendulum, arm, settings, actuator)
    if found.use <= CLOSE:
        return None
    slow = settings.plant.max_speed
    at_speed = "" if slow is None else f" at up to {slow:g} m/s"
    leans = (
        f"phi + phi_dot / {fall_rate(pendulum) + pendulum.c:.1f} is "
        f"{degrees(found.gentlest):.1f} to {degrees(found.worst):.1f} deg when the arm responds, "
        f"{1e3 * found.delay:.0f} ms after the release, and {paper.U_MAX:g} m/s^2 on a track of "
        f"{paper.X_LIMIT:g} m{at_speed} turn back at most {degrees(found.limit):.1f} deg"
    )
    other = "longer" if fall_rate(pendulum) * found.delay > 0.5 else "shorter"
    cure = (
        "shorten the delay, release more gently (evaluation.phi_high, evaluation.phi_dot_high), or "
        f"{f'take a {other} pendulum' if slow is None else 'raise the speed limit'}"
    )
    if found.share == 1.0:
        reach = f"the worst release reaches {100.0 * found.use:.0f} % of the physical limit"
        return f"{reach}, and a table may lose it: {leans}; {cure}"
    if found.share == 0.0:
        raise SettingsError(f"no controller balances this pendulum: {leans}; {cure}")
    lost = f"no controller saves {100.0 * (1.0 - found.share):.2g} % of the releases: {leans}"
    if found.share < least:
        raise SettingsError(f"{lost}; expected at most {100.0 * (1.0 - least):.2g} %; {cure}")
    return f"{lost}; {cure}"


class Boundary(NamedTuple):
    """Boundary of a slice of the recoverable set, after the delay; odd symmetric, star-shaped."""

    points: Array
    """Points in the plane, by rising angle from -pi, shape (n, 2)."""
    scale: tuple[float, float]
    """Units of the axes in which the angle is measured."""

    def share(self, points: Array) -> Array:
        """Return how far out points are: 0 in the middle, 1 on the boundary, shape (m,)."""
        scaled, edge = points / self.scale, self.points / self.scale
        angles = np.arctan2(edge[:, 1], edge[:, 0])
        after = np.searchsorted(angles, np.arctan2(scaled[:, 1], scaled[:, 0])) % len(edge)
        p, q = edge[after - 1], edge[after]
        normal = np.column_stack((q[:, 1] - p[:, 1], p[:, 0] - q[:, 0]))
        return np.sum(normal * scaled, axis=1) / np.sum(normal * p, axis=1)


def boundary(
    params: RecoveryParams,
    plane: tuple[tuple[float, ...], tuple[float, ...]] = PENDULUM_PLANE,
    *,
    sufficient: bool = False,
) -> Boundary:
    """Return the boundary of the necessary set, or of the sufficient one, in a plane.

    Args:
        params: Parameters.
        plane: The axes of the plane.
        sufficient: Return the sufficient set.
    """
    across, up = np.array(plane)
    if plane == FLANGE_PLANE:
        scale = params.x_limit, sqrt(2.0 * params.u_max * params.x_limit)
    else:
        scale = params.phi_limit, params.phi_limit * params.fade
    # The pendulum and its mirror image have mirrored sets.
    half: list[tuple[float, float]] = []
    for angle in np.pi * (np.arange(DIRECTIONS // 2) / (DIRECTIONS // 2)):
        a, b = scale[0] * np.cos(angle), scale[1] * np.sin(angle)
        direction = a * across + b * up
        if sufficient:
            factor, _ = largest_recovery(params, direction)
        else:
            factor = largest_start(params, direction)
        half.append((factor * a, factor * b))
    points = np.array(half)
    return Boundary(np.concatenate((-points, points)), scale)


def _ticks(params: RecoveryParams) -> int:
    return min(MAX_TICKS, ceil(TIME_CONSTANTS / params.rate / params.h))


def _linear(params: RecoveryParams) -> tuple[Array, Array]:
    """Return the matrices of a tick of flange and linear pendulum, shapes (4, 4) and (4,)."""
    w2, k, c = params.pendulum[:3]
    M = np.zeros((5, 5))
    M[0, 1] = M[2, 3] = M[1, 4] = 1.0
    M[3, 2:] = w2, -c, -k
    E: Any = expm(M * params.h)
    return E[:4, :4], E[:4, 4]


def _help(params: RecoveryParams) -> Array:
    """Return the effects of additional accelerations in favour of the pendulum, shape (4, 2).

    Columns: the largest effect of a tick on the diverging and on the converging angle. Both are
    bounded separately, which includes every course within the tick.
    """
    w2, k, _, f, drag = params.pendulum[:5]
    a, rate, other, h = params.phi_limit, params.rate, params.fade, params.h
    largest = f
    if not params.pendulum.linearised:
        largest += w2 * (a - sin(a)) + k * params.u_max * (1.0 - cos(a))
    # Within the limits the diverging angle bounds the angular velocity.
    largest += drag * (other * (a + params.largest)) ** 2
    grows = largest / other * (exp(rate * h) - 1.0) / rate
    fades = largest / rate * (1.0 - exp(-other * h)) / other
    both = rate + other
    help_ = np.zeros((4, 2))
    help_[2] = other * grows / both, rate * fades / both
    help_[3] = rate * other * grows / both, -rate * other * fades / both
    return help_


def _linearised(
    params: RecoveryParams, states: Array, u: Array
) -> tuple[Array, list[Array], list[Array]]:
    """Return the next states of the nonlinear pendulum, and their derivatives at each tick."""
    h, pendulum = params.h, params.pendulum._replace(coulomb=0.0)
    after = np.empty_like(states)
    after[:, 0] = states[:, 0] + h * states[:, 1] + 0.5 * h * h * u
    after[:, 1] = states[:, 1] + h * u
    As: list[Array] = []
    bs: list[Array] = []
    small = 1e-5
    for i, (phi, phi_dot) in enumerate(states[:, 2:].tolist()):
        a = float(u[i])
        after[i, 2:] = here = step(phi, phi_dot, a, h, pendulum)
        A, b = np.eye(4), np.array([0.5 * h * h, h, 0.0, 0.0])
        A[0, 1] = h
        for column, moved in (
            (2, step(phi + small, phi_dot, a, h, pendulum)),
            (3, step(phi, phi_dot + small, a, h, pendulum)),
        ):
            A[2:, column] = (moved[0] - here[0]) / small, (moved[1] - here[1]) / small
        moved = step(phi, phi_dot, a + small, h, pendulum)
        b[2:] = (moved[0] - here[0]) / small, (moved[1] - here[1]) / small
        As.append(A)
        bs.append(b)
    return after, As, bs


def _solve(
    params: RecoveryParams,
    direction: Array,
    As: list[Array],
    bs: list[Array],
    *,
    rest: Array | None = None,
    helps: Array | None = None,
) -> tuple[float, Array, Array]:
    """Maximise the factor on a state from which the limits hold at each tick.

    Args:
        params: Parameters.
        direction: The state, shape (4,).
        As: Derivatives of the next state to the state, shape (4, 4) each.
        bs: Derivatives of the next state to u, shape (4,) each.
        rest: Constant part of the next states, shape (n, 4); pendulum and flange come to rest.
        helps: Effects of additional accelerations, shape (4, m).

    Returns:
        The factor, u at each tick [m/s^2], shape (n,), and the next states, shape (n, 4).

    Raises:
        SettingsError: The program has no solution.
    """
    N, extra = len(As), 0 if helps is None else helps.shape[1]
    # Unknowns: the factor, all u, the additional accelerations, all next states.
    states = eye_array(4 * N, format="csr")
    before = block_diag([np.zeros((4, 0)), *As[1:], np.zeros((0, 4))], format="csr")
    parts = [
        csr_array(np.concatenate((As[0] @ direction, np.zeros(4 * N - 4)))[:, None]),
        block_diag([b[:, None] for b in bs]),
        *([] if helps is None else [block_diag([helps] * N)]),
        before - states,
    ]
    right = np.zeros(4 * N) if rest is None else -rest.ravel()
    limits = (params.x_limit, params.speed_limit, params.phi_limit, inf)
    low = np.concatenate(([0.0], np.full(N, -params.u_max), np.full(extra * N, -1.0)))
    low = np.concatenate((low, -np.tile(limits, N)))
    high = -low
    high[0] = inf
    if rest is not None:
        low[-3:] = high[-3:] = 0.0
    found: Any = linprog(
        -np.eye(1, len(low))[0],
        A_eq=block_array([parts]),
        b_eq=right,
        bounds=np.column_stack((low, high)),
        method="highs",
    )
    if found.x is None:
        raise SettingsError(f"no recovery was computed ({found.message}); check the pendulum")
    return float(found.x[0]), found.x[1 : 1 + N], found.x[-4 * N :].reshape(N, 4)
