r"""Recoverable set: releases of the pendulum that some controller can balance.

Failure angle and track make it smaller than the bound of `equipoise.simulation.reachability`: the
flange must also stop before its end.

The arm is modelled as a delay T, after which it accelerates with :math:`|u| \le u_{max}`, held for
a tick. A linear program over the ticks encloses the recoverable set: the linear pendulum receives
an additional acceleration up to the largest that sine, cosine, dry friction and drag can add within
the failure angle, in its favour. No controller recovers a release outside that convex set.
"""

from math import ceil, cos, exp, inf, log, sin
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import expm
from scipy.optimize import linprog

from equipoise import paper
from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arrays import fields, new_records
from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.errors import SettingsError
from equipoise.model.actuator import CYCLE, Actuator, Servos, follow, lag_fraction
from equipoise.model.pendulum import PendulumParameters, step
from equipoise.settings import Settings
from equipoise.simulation.reachability import diverging_angle, fall_rate, recoverable_angle

Array = npt.NDArray[np.float64]

TIME_CONSTANTS = 10.0
"""Length of a recovery in time constants of the fall: twice as long changes the set by less than
0.1 %."""
MAX_TICKS = 400
"""Limit on the ticks of a recovery; the set stays valid for a slower fall."""
MAX_GROWTH = 10.0
"""Growth of the fall within a tick, in powers of e, beyond which the track has no effect."""
MAX_RATE = 200.0
"""Limit on lambda for the delay of the arm [1/s]: faster falls see the transport alone."""
RESPONSE_TIME = 0.3
"""Simulated time of the arm's response to constant acceleration [s]; it follows within 0.1 s."""
FALL_STEP = 0.1
"""Length of a Runge-Kutta step over the delay, in time constants of the fall."""


class RecoveryParams(NamedTuple):
    """Parameters of a recovery."""

    pendulum: PendulumParameters
    """The pendulum."""
    delay: float
    """T, from the release to the acceleration of the flange [s]."""
    u_max: float = paper.U_MAX
    """Largest acceleration of the flange [m/s^2]."""
    phi_limit: float = paper.PHI_LIMIT
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
        return recoverable_angle(self.pendulum, self.u_max)


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
    records = new_records(Servos)
    servos = fields(records, Servos)
    servos.fraction[:, 0] = [float(lag_fraction(lag.value)) for lag in actuator.lags]
    interval = round(paper.STEP / SETPOINTS_PER_TICK / CYCLE)
    late, cycles = round(actuator.delay.value / CYCLE), round(RESPONSE_TIME / CYCLE)
    v = np.zeros(cycles)
    for cycle in range(cycles):
        # A setpoint is the place of the reference at the end of its interval.
        sent = max((cycle - late) // interval + 1, 0) * interval * CYCLE
        servos.target[:, 0] = 0.5 * u_max * sent**2 * along_x
        follow(servos, actuator.parameters, 0, 1)
        v[cycle] = of_pivot @ servos.dq[:, 0]
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
    steps = max(4, min(1000, ceil(abs(time) * params.rate / FALL_STEP)))
    after = np.array(states, np.float64)
    after[:, 0] += time * after[:, 1]
    for row in after:
        phi, phi_dot = float(row[2]), float(row[3])
        for _ in range(steps if time else 0):
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

    Raises:
        SettingsError: The linear program has no solution.
    """
    if params.rate * params.h > MAX_GROWTH:
        angle = diverging_angle(direction[2], direction[3], params.pendulum)
        return float(abs(params.largest / angle))
    w2, k, c = params.pendulum[:3]
    M = np.zeros((5, 5))
    M[0, 1] = M[2, 3] = M[1, 4] = 1.0
    M[3, 2:] = w2, -c, -k
    E: Any = expm(M * params.h)
    A, b = E[:4, :4], E[:4, 4:]
    N = min(MAX_TICKS, ceil(TIME_CONSTANTS / params.rate / params.h))
    ticks = sparse.eye_array(N)
    first = sparse.csr_array((A @ direction)[:, None])
    first.resize((4 * N, 1))
    # Unknowns: the factor, u and the additional accelerations of each tick, all next states.
    parts = [
        first,
        sparse.kron(ticks, b),
        sparse.kron(ticks, _help(params)),
        sparse.kron(sparse.eye_array(N, k=-1), A) - sparse.eye_array(4 * N),
    ]
    limits = (params.x_limit, params.speed_limit, params.phi_limit, inf)
    high = np.concatenate(([inf], np.full(N, params.u_max), np.ones(2 * N), np.tile(limits, N)))
    low = -high
    low[0] = 0.0
    solution: Any = linprog(
        -np.eye(1, len(low))[0],
        A_eq=sparse.hstack(parts),
        b_eq=np.zeros(4 * N),
        bounds=np.column_stack((low, high)),
        method="highs",
    )
    if solution.x is None:
        raise SettingsError(f"no recovery was computed ({solution.message}); check the pendulum")
    return float(solution.x[0])


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
