r"""Control step: observation, prediction, decision, command.

Once per tick of h = 0.01 s, all on the state in `ControllerState`::

    observe   counts, measured q  ->  the policy's observation
    (act)     the policy's table  ->  u
    command   u  ->  CLIK  ->  two setpoints for the joints, h / 2 apart

A setpoint moves the arm only a transport delay d after it was sent, and then as fast as servo and
drive allow. So the controller keeps a model of the arm (`equipoise.model.actuator`) that runs on
the setpoints as they are *sent*: its present state is that of the arm at t + d, its history holds
the arm's state now. Slow differences to the measured q are added to it. Therefore:

1. The pendulum's observer (`equipoise.control.linear`) takes the acceleration of the pivot now
   from the model's history.
2. The prediction propagates phi and phi_dot over the motion in flight until t + d, and from there
   to the horizon T while the velocity ramps to that of the reference. At t + T the arm is where the
   reference is now: this is the policy's observation, and u changes it at once, as in the paper.

CLIK closes its loop on the *commanded* joints: no delay can make it unstable. The encoder measures
the pendulum relative to the flange; the flange's own rotation about the spindle is added.

Training, evaluation and deployment run these kernels, on blocks of lanes
(`equipoise.elementary`); a rig uses one lane.
"""

from collections.abc import Sequence
from math import cos, floor, pi
from typing import Annotated, Final, NamedTuple, Protocol

import numpy as np

from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arm.chain import wrist_centre
from equipoise.arm.clik import (
    GAMMA,
    REFERENCE_SIZE,
    ClikParameters,
    joint_acceleration,
    manipulability,
    pose_error,
    solve,
)
from equipoise.arm.compiler import FRAME_SIZE, POSITION, ROTATION, TWIST, addresses
from equipoise.arrays import Array, IntArray
from equipoise.control.linear import Gains, observer_gains
from equipoise.control.policy import Observation
from equipoise.elementary import BATCH_SIZE
from equipoise.errors import ArmError, SettingsError
from equipoise.jit import call, compilable, flat, inlined, pointer
from equipoise.model.actuator import (
    CYCLE,
    IDEAL,
    ROWS,
    Actuator,
    ActuatorParameters,
    Servos,
    follow_setpoint,
    lag_fraction,
    motion_of,
    steady_error,
)
from equipoise.model.pendulum import PendulumParameters, runge_kutta
from equipoise.settings import Settings

CORRECTION: Final = 0.1
"""Fraction of the difference between measured and modelled joints that is corrected per tick: a
time constant of 0.1 s. The model is faster than the measurement; only slow differences, such
as the sag under the pendulum's weight, are significant."""

SETPOINTS_PER_TICK: Final = 2
"""Setpoints per tick: at 100 Hz a servo with a shaping law would move the joints in bursts of four
times their mean speed, at 200 Hz of twice."""
HISTORY_TICKS: Final = 12
"""Number of ticks of the arm's motion in the history."""

LANES: Final = (BATCH_SIZE,)
"""Shape of a field with one number for each lane."""


class ControllerParams(NamedTuple):
    """Constants of the controller, from `make_controller_params`.

    Numbers and tuples of them alone: for each array among its arguments a kernel counts references,
    which takes as long as a formula.
    """

    kinematics: int
    """Address of the arm's compiled kinematics."""
    motion: int
    """That of the same without J and J_dot dq."""
    clik: ClikParameters
    """Gains and damping."""
    limits: tuple[tuple[float, ...], ...]
    """Lower, upper, velocity and acceleration limits of the free joints."""
    home: tuple[float, ...]
    """Free joints at x = 0 [rad]."""
    home_reference: tuple[float, ...]
    """Pose of the flange at home, at rest, as a reference of `REFERENCE_SIZE` numbers."""
    pivot: tuple[float, float, float]
    """The pendulum's pivot in the flange frame [m]."""
    h: float
    """Time between ticks [s]."""
    has_sensor: bool
    """Whether a sensor and an actuator are modelled; otherwise the state is measured exactly."""
    actuator: ActuatorParameters
    """The model of the arm."""
    lags: tuple[float, ...]
    """Time constant of each free joint [s]."""
    delay: float
    """d, from sending a setpoint to its effect [s]."""
    horizon: float
    """Prediction horizon T, from the measurement to the observation [s]; 0 without prediction."""
    pendulum: PendulumParameters
    """Nominal parameters."""
    gains: Gains
    """Gains of the pendulum's observer."""
    resolution: float
    """Angle of one encoder count, with the encoder's sign [rad]."""
    correction: float
    """Fraction of the difference between measured and modelled q that is corrected per tick [-]."""
    follow_setpoint: int = 0
    """Address of the compiled `equipoise.model.actuator.follow_setpoint`: each function is compiled
    once, for all loops. Those of this module follow."""
    start_controller: int = 0
    observe: int = 0
    command: int = 0
    advance_arm_model: int = 0


class Motion(Protocol):
    """Motion of the modelled arms at a tick."""

    pivot_v: Annotated[Array, LANES]
    """Velocity of the pivot along x [m/s]."""
    x: Annotated[Array, LANES]
    """Displacement of the flange from home [m]."""
    tilt: Annotated[Array, LANES]
    """Rotation of the flange about the spindle [rad]."""
    q: Annotated[Array, ROWS]
    """Joints [rad]."""


class Estimate(Protocol):
    """Estimate of the pendulum's observer at the tick."""

    phi: Annotated[Array, LANES]
    """Angle of the pendulum from upright [rad]."""
    phi_dot: Annotated[Array, LANES]
    """Its rate [rad/s]."""
    bias: Annotated[Array, LANES]
    """Encoder zero offset [rad]."""
    pivot_v: Annotated[Array, LANES]
    """Velocity of the pivot along x [m/s]."""
    x: Annotated[Array, LANES]
    """Displacement of the flange from home [m]."""


class Observed(Protocol):
    """States of flange and pendulum."""

    x: Annotated[Array, LANES]
    """Displacement of the flange from home [m]."""
    x_dot: Annotated[Array, LANES]
    """Its velocity [m/s]."""
    phi: Annotated[Array, LANES]
    """Angle of the pendulum from upright [rad]."""
    phi_dot: Annotated[Array, LANES]
    """Its rate [rad/s]."""


class ControllerState(Protocol):
    """State of the controllers of `BATCH_SIZE` lanes; kernels change it in place."""

    q: Annotated[Array, ROWS]
    """Commanded free joints [rad]."""
    dq: Annotated[Array, ROWS]
    """Their velocities [rad/s]."""
    ddq: Annotated[Array, ROWS]
    """Their accelerations over the last tick [rad/s^2]."""
    frame: Annotated[Array, (FRAME_SIZE, BATCH_SIZE)]
    """Record of the kinematics at q, dq."""
    reference: Annotated[Array, (REFERENCE_SIZE, BATCH_SIZE)]
    """Record of the flange's reference."""
    e: Annotated[Array, ROWS]
    """Pose error, then the bracket of equation (3)."""
    noise: Annotated[Array, ROWS]
    """Disturbance of the pose error in the next command [m], [rad]; zero on a rig."""
    u: Annotated[Array, LANES]
    """Acceleration for the next command [m/s^2]."""
    setpoints: Annotated[Array, (SETPOINTS_PER_TICK, *ROWS)]
    """Joints to send at the tick and h / 2 later [rad]."""
    limit_exceeded: Annotated[IntArray, LANES]
    """Whether the last command left the limits of a joint."""
    balancing: Annotated[IntArray, LANES]
    """Whether the policy balances, so that the failure angle applies; not in a swing-up."""
    counts: Annotated[Array, LANES]
    """Measurement: encoder counts."""
    measured: Annotated[Array, ROWS]
    """Measurement: free joints [rad]."""
    model: Servos
    """Modelled arm at t + d."""
    model_frame: Annotated[Array, (FRAME_SIZE, BATCH_SIZE)]
    """Position, rotation and twist of its flange."""
    offset: Annotated[Array, ROWS]
    """Measured minus modelled joints, slowly varying [rad]."""
    corrected: Annotated[Array, ROWS]
    """Modelled joints with that offset [rad]."""
    history: Annotated[Sequence[Motion], (HISTORY_TICKS,)]
    """Motion of the model at the last ticks."""
    shown: Annotated[Array, LANES]
    """Angle of the pendulum from upright that the counts show [rad]."""
    estimate: Estimate
    """Estimate of the observer."""
    observation: Observed
    """Observation of the policy."""
    pivot_v: Annotated[Array, LANES]
    """Velocity of the pivot along x at a tick of the history [m/s]: a compiler vectorises a large
    loop over fields at fixed places alone, and those of `history` move."""
    newest: Annotated[IntArray, LANES]
    """Index of the newest tick of the history, equal in all lanes."""


def make_controller_params(
    arm: Arm,
    settings: Settings,
    actuator: Actuator,
    pendulum: PendulumParameters,
    *,
    h: float,
    counts_per_rev: int | None = None,
    has_sensor: bool = True,
) -> ControllerParams:
    """Return the constants of a controller.

    Args:
        arm: The arm with its home posture.
        settings: The sections `clik`, `controller` and `plant`.
        actuator: The model of the arm's response.
        pendulum: Nominal parameters.
        h: Time between ticks [s].
        counts_per_rev: Encoder counts per revolution, after x4; by default those of `settings`.
        has_sensor: Whether a sensor and an actuator are modelled.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay is longer than the history.
    """
    whole, motion = addresses(arm)
    q, dq, frame = np.zeros(ROWS), np.zeros(ROWS), np.zeros((FRAME_SIZE, BATCH_SIZE))
    q[:, 0] = arm.home_free
    kinematics(whole, q, dq, frame, 1)
    w = float(manipulability(frame, 0))
    if w < 1e-6:  # [m^3]: an iiwa at home has 0.09
        raise ArmError(
            f"the home posture of {arm.name} is singular (|det J| = {w:.1e} m^3); choose another"
        )
    max_delay = (HISTORY_TICKS - 3) * h
    if actuator.delay.value > max_delay:
        raise SettingsError(
            f"the actuator's delay is {1e3 * actuator.delay.value:.0f} ms, expected at most "
            f"{1e3 * max_delay:.0f} ms, the controller's history; shorten the delay of the link"
        )
    limits = ((j.lower, j.upper, j.velocity, j.acceleration) for j in arm.free_joints)
    own, clik = settings.controller, settings.clik
    counts_per_rev = counts_per_rev or settings.plant.counts_per_rev
    params = ControllerParams(
        kinematics=whole,
        motion=motion,
        # The inverse is damped below a twentieth of the manipulability at home.
        clik=ClikParameters(clik.K_p, clik.K_d, 0.05 * w, lambda_0=0.05, wrist=wrist_centre(arm)),
        limits=tuple(zip(*limits, strict=True)),
        home=tuple(arm.home_free.tolist()),
        home_reference=tuple(frame[:REFERENCE_SIZE, 0].tolist()),
        pivot=arm.pivot,
        h=h,
        has_sensor=has_sensor,
        actuator=actuator.parameters,
        lags=tuple(lag.value for lag in actuator.lags),
        delay=actuator.delay.value,
        horizon=horizon(arm, actuator, own.margin) if own.predict else 0.0,
        pendulum=pendulum,
        gains=observer_gains(pendulum, counts_per_rev, h, estimate_bias=own.estimate_bias),
        resolution=2.0 * pi / counts_per_rev,
        correction=CORRECTION,
    )
    state, measured = ControllerState, Observation(0.0, 0.0, 0.0, 0.0)
    return params._replace(
        follow_setpoint=pointer(follow_setpoint, Servos, params.actuator, 0, False, 0),
        start_controller=pointer(start_controller, params, state, measured, 0),
        observe=pointer(observe, params, state, (0.0, 0.0), 0),
        command=pointer(command, params, state, 0),
        advance_arm_model=pointer(advance_arm_model, params, state, 0),
    )


def horizon(arm: Arm, actuator: Actuator, margin: float) -> float:
    """Return the prediction horizon of the policy [s].

    The sum of the transport delay, of its uncertainty upwards (`margin` at least: too long a
    horizon costs little, too short a one the balance), and of the response time of the flange along
    x: that of the joints, weighted by their part in the motion at home.

    Args:
        arm: The arm with its home posture.
        actuator: Model of the arm's response.
        margin: Minimum margin beyond the delay [s].
    """
    if actuator.kind == "ideal":
        return 0.0
    delay = actuator.delay
    effect = delay.value + max(delay.high - delay.value, margin)
    J = arm.kinematics(arm.home_free).jacobian
    part = J[0] * np.linalg.solve(J, np.eye(FREE_JOINTS)[0])
    follows = [actuator.response_time(joint) for joint in range(FREE_JOINTS)]
    return effect + float(part @ follows)


@inlined
def kinematics(function: int, q: Array, dq: Array, frame: Array, lanes: int) -> None:
    """Write the records of the flanges of the first lanes.

    Args:
        function: Address of the arm's kinematics.
        q: Free joints [rad], 6 rows.
        dq: Their velocities [rad/s], 6 rows.
        frame: Receives the records.
        lanes: Number of lanes.
    """
    call(function, (flat(q), flat(dq), flat(frame), lanes))


@compilable
def place_command(
    controller: ControllerParams, state: ControllerState, x: float, x_dot: float, n: int
) -> None:
    """Set the command of lane `n` to a place on the track, without pose error.

    Args:
        controller: Constants.
        state: Changed in place.
        x: Displacement of the flange from home along base x [m].
        x_dot: Its velocity [m/s].
        n: Lane.
    """
    q, dq, e, change = np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS)
    frame = np.zeros((FRAME_SIZE, BATCH_SIZE))
    reference = np.zeros((REFERENCE_SIZE, BATCH_SIZE))
    for i in range(REFERENCE_SIZE):
        reference[i, 0] = controller.home_reference[i]
    reference[POSITION, 0] += x
    for i in range(FREE_JOINTS):
        q[i, 0] = controller.home[i]
    for _ in range(20):  # Newton's iteration to the posture
        kinematics(controller.kinematics, q, dq, frame, 1)
        error = pose_error(frame, reference, 0)
        largest = 0.0
        for i in range(6):
            e[i, 0] = error[i]
            largest = max(largest, abs(error[i]))
        if largest < 1e-12:  # [m], [rad]
            break
        solve(frame, e, controller.clik, change, 1)
        for i in range(FREE_JOINTS):
            q[i, 0] += change[i, 0]
    for i in range(6):
        e[i, 0] = x_dot if i == 0 else 0.0
    solve(frame, e, controller.clik, dq, 1)
    kinematics(controller.kinematics, q, dq, frame, 1)
    reference[TWIST, 0] = x_dot
    for i in range(FREE_JOINTS):
        state.q[i, n], state.dq[i, n], state.ddq[i, n] = q[i, 0], dq[i, 0], 0.0
    for i in range(FRAME_SIZE):
        state.frame[i, n] = frame[i, 0]
    for i in range(REFERENCE_SIZE):
        state.reference[i, n] = reference[i, 0]


def start_controller(
    controller: ControllerParams, state: ControllerState, measured: Observation, n: int
) -> None:
    """Start lane `n` with an arm that moves steadily and the measured pendulum.

    Args:
        controller: Constants.
        state: Changed in place.
        measured: The measured state.
        n: Lane.
    """
    x, x_dot, phi, phi_dot = measured
    place_command(controller, state, x, x_dot, n)
    state.limit_exceeded[n] = 0
    state.balancing[n] = 1 if cos(phi) > 0.0 else 0
    h, model = controller.h, state.model
    for i in range(FREE_JOINTS):
        dq = state.dq[i, n]
        q = state.q[i, n] - steady_error(dq, controller.lags[i], controller.actuator)
        model.q[i, n], model.dq[i, n], state.offset[i, n] = q, dq, 0.0
        model.fraction[i, n] = lag_fraction(controller.lags[i])
        for j in range(HISTORY_TICKS):
            tick_before(state, j).q[i, n] = q - j * h * dq
    for j in range(HISTORY_TICKS):
        motion = tick_before(state, j)
        motion.pivot_v[n], motion.x[n], motion.tilt[n] = x_dot, x - j * h * x_dot, 0.0
    estimate, observation = state.estimate, state.observation
    estimate.phi[n], estimate.phi_dot[n], estimate.bias[n] = phi, phi_dot, 0.0
    estimate.pivot_v[n], estimate.x[n] = x_dot, x
    # The arm moves steadily: over the horizon the pendulum falls by itself.
    phi, phi_dot = runge_kutta(phi, phi_dot, 0.0, controller.horizon, 0.0, controller.pendulum)
    observation.x[n], observation.x_dot[n] = x, x_dot
    observation.phi[n], observation.phi_dot[n] = phi, phi_dot


@inlined
def tick_before(state: ControllerState, j: int) -> Motion:
    """Return the motion of the model `j` ticks before the newest."""
    return state.history[(state.newest[0] - j) % HISTORY_TICKS]


@inlined
def wrapped(angle: float) -> float:
    """Return an angle in [-pi, pi)."""
    return angle - 2.0 * pi * floor((angle + pi) / (2.0 * pi))


def observe(
    controller: ControllerParams, state: ControllerState, ages: tuple[float, float], lanes: int
) -> None:
    """Compute the observations from the measurements in `state`, in the first lanes.

    Formulas are computed in all lanes: the compiler knows their number, and fills whole registers.

    Args:
        controller: Constants.
        state: Reads `counts` and `measured`; changed in place.
        ages: Ages of the counts and of the measured joints [s].
        lanes: Number of lanes.
    """
    encoder_age, reply_age = ages
    estimate, observation, offset = state.estimate, state.observation, state.offset
    measured, counts, shown, frame = state.measured, state.counts, state.shown, state.frame
    h, delay, pendulum, v = controller.h, controller.delay, controller.pendulum, state.pivot_v
    on_phi, on_phi_dot, on_bias = controller.gains
    resolution, correction = controller.resolution, controller.correction

    # The offset of the joints, at the time of their measurement.
    back = (delay + reply_age) / h
    near, far = tick_before(state, int(back)), tick_before(state, int(back) + 1)
    f = back - int(back)
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            q = near.q[i, n] + f * (far.q[i, n] - near.q[i, n])
            offset[i, n] += correction * (measured[i, n] - q - offset[i, n])

    # The angle that the counts show, at their time: the encoder turns with the flange.
    back = (delay + encoder_age) / h
    near, far = tick_before(state, int(back)), tick_before(state, int(back) + 1)
    f = back - int(back)
    for n in range(BATCH_SIZE):
        tilt = near.tilt[n]
        shown[n] = pi - counts[n] * resolution + tilt + f * (far.tilt[n] - tilt)

    # The observer: u is the acceleration of the pivot over the last tick.
    whole = int(delay / h)
    near, far, f = tick_before(state, whole), tick_before(state, whole + 1), delay / h - whole
    for n in range(BATCH_SIZE):
        estimate.x[n] = near.x[n] + f * (far.x[n] - near.x[n])
        v[n] = near.pivot_v[n] + f * (far.pivot_v[n] - near.pivot_v[n])
    for n in range(BATCH_SIZE):
        pivot_v = v[n]
        u = (pivot_v - estimate.pivot_v[n]) / h
        phi, phi_dot = runge_kutta(estimate.phi[n], estimate.phi_dot[n], u, h, 0.0, pendulum)
        innovation = wrapped(shown[n] - estimate.bias[n] - phi + encoder_age * phi_dot)
        estimate.phi[n] = wrapped(phi + on_phi * innovation)
        estimate.phi_dot[n] = phi_dot + on_phi_dot * innovation
        # On average only a balanced pendulum is upright.
        estimate.bias[n] += on_bias * state.balancing[n] * innovation
        estimate.pivot_v[n] = pivot_v
    for n in range(BATCH_SIZE):
        observation.x[n], observation.x_dot[n] = estimate.x[n], estimate.pivot_v[n]
        observation.phi[n], observation.phi_dot[n] = estimate.phi[n], estimate.phi_dot[n]
    if controller.horizon == 0.0:
        return
    # The prediction: the motion in flight until t + d, tick by tick, then until the horizon.
    time = delay - whole * h
    for j in range(whole, -1, -1):
        if time > 1e-9:  # [s]: not a rounding
            then = tick_before(state, j)
            for n in range(BATCH_SIZE):
                v[n] = then.pivot_v[n]
            for n in range(BATCH_SIZE):
                _propagate(observation, v[n], time, pendulum, n)
        time = h
    time = controller.horizon - delay
    home_x = controller.home_reference[POSITION]
    if time > 1e-9:  # [s]: not a rounding
        for n in range(BATCH_SIZE):
            _propagate(observation, frame[TWIST, n], time, pendulum, n)
    for n in range(BATCH_SIZE):
        observation.x[n] = frame[POSITION, n] - home_x
        observation.x_dot[n] = frame[TWIST, n]


@inlined
def _propagate(
    predicted: Observed, pivot_v: float, time: float, pendulum: PendulumParameters, n: int
) -> None:
    """Propagate the predicted pendulum of lane `n` while the pivot velocity ramps to `pivot_v`."""
    u = (pivot_v - predicted.x_dot[n]) / time
    predicted.phi[n], predicted.phi_dot[n] = runge_kutta(
        predicted.phi[n], predicted.phi_dot[n], u, time, 0.0, pendulum
    )
    predicted.x_dot[n] = pivot_v


def command(controller: ControllerParams, state: ControllerState, lanes: int) -> None:
    """Compute the setpoints of the joints from u, in the first lanes.

    Reads `state.u` and `state.noise`; writes `state.setpoints`, and advances the commanded joints
    and the model of the arm to the end of the tick.

    Args:
        controller: Constants.
        state: Changed in place.
        lanes: Number of lanes.
    """
    q, dq, ddq, frame, reference = state.q, state.dq, state.ddq, state.frame, state.reference
    e, noise, u, setpoints = state.e, state.noise, state.u, state.setpoints
    limit_exceeded, h = state.limit_exceeded, controller.h
    lower, upper, max_velocity, max_acceleration = controller.limits
    for n in range(BATCH_SIZE):
        e[0, n], e[1, n], e[2, n], e[3, n], e[4, n], e[5, n] = pose_error(frame, reference, n)
        reference[GAMMA, n] = u[n]
    for i in range(6):
        for n in range(BATCH_SIZE):
            e[i, n] += noise[i, n]
    joint_acceleration(frame, reference, e, controller.clik, ddq, lanes)
    for n in range(BATCH_SIZE):
        reference[POSITION, n] += reference[TWIST, n] * h + 0.5 * u[n] * h * h
        reference[TWIST, n] += u[n] * h
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            setpoints[0, i, n] = q[i, n] + 0.5 * dq[i, n] * h + 0.125 * ddq[i, n] * h * h
            setpoints[1, i, n] = q[i, n] + (dq[i, n] * h + 0.5 * ddq[i, n] * h * h)
            q[i, n] = setpoints[1, i, n]
            dq[i, n] += ddq[i, n] * h
    for n in range(BATCH_SIZE):
        within = True
        for i in range(FREE_JOINTS):
            within &= (lower[i] <= q[i, n]) & (q[i, n] <= upper[i])
            within &= (abs(dq[i, n]) <= max_velocity[i]) & (abs(ddq[i, n]) <= max_acceleration[i])
        limit_exceeded[n] = 0 if within else 1
    kinematics(controller.kinematics, q, dq, frame, lanes)
    if controller.has_sensor:
        call(controller.advance_arm_model, (controller, state, lanes))


def advance_arm_model(controller: ControllerParams, state: ControllerState, lanes: int) -> None:
    """Advance the model of the arm to the end of the tick, and record its motion.

    Args:
        controller: Constants.
        state: Changed in place.
        lanes: Number of lanes.
    """
    model, frame, corrected = state.model, state.model_frame, state.corrected
    cycles = round(controller.h / SETPOINTS_PER_TICK / CYCLE)
    for s in range(SETPOINTS_PER_TICK):
        for i in range(FREE_JOINTS):
            for n in range(BATCH_SIZE):
                model.target[i, n] = state.setpoints[s, i, n]
        call(controller.follow_setpoint, (model, controller.actuator, cycles, False, lanes))
    newest = (state.newest[0] + 1) % HISTORY_TICKS
    for n in range(BATCH_SIZE):
        state.newest[n] = newest
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            corrected[i, n] = model.q[i, n] + state.offset[i, n]
    velocity = motion_of(model, controller.actuator)
    if controller.actuator.kind == IDEAL:
        velocity = state.dq  # it jumps to each setpoint and then rests
    kinematics(controller.motion, corrected, velocity, frame, lanes)
    home_x = controller.home_reference[POSITION]
    now = tick_before(state, 0)
    for n in range(BATCH_SIZE):
        now.pivot_v[n] = pivot_velocity(frame, controller.pivot, n)
        now.x[n] = frame[POSITION, n] - home_x
        now.tilt[n] = -pose_error(frame, state.reference, n)[4]
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            now.q[i, n] = model.q[i, n]


@inlined
def pivot_velocity(frame: Array, pivot: tuple[float, float, float], n: int) -> float:
    """Return the velocity of the pendulum's pivot along x in lane `n` [m/s].

    Args:
        frame: Record of the arm's kinematics.
        pivot: The pivot in the flange frame [m].
        n: Lane.
    """
    px, py, pz = pivot
    r = ROTATION
    y = frame[r + 3, n] * px + frame[r + 4, n] * py + frame[r + 5, n] * pz
    z = frame[r + 6, n] * px + frame[r + 7, n] * py + frame[r + 8, n] * pz
    return frame[TWIST, n] + frame[TWIST + 4, n] * z - frame[TWIST + 5, n] * y
