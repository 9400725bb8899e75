r"""Control step: observation, prediction, decision, command.

Once per tick of h = 0.01 s, all on the state in `ControllerState`::

    observe   counts, measured q  ->  the policy's observation
    (act)     the policy's table  ->  u
    command   u  ->  CLIK  ->  two setpoints for the joints, h / 2 apart

A setpoint moves the arm only a transport delay d after it was sent, and then as fast as servo and
drive allow. So the controller keeps a model of the arm (`equipoise.model.actuator`) that runs on
the setpoints as they are *sent*: its present state is that of the arm at t + d, its history holds
the arm's state now. Slow differences to the measured q are added to it. Therefore:

1. The pendulum's observer (`equipoise.control.estimator`) takes the acceleration of the pivot now
   from the model's history.
2. The prediction propagates phi and phi_dot over the motion in flight until t + d, and from there
   to the horizon T while the velocity ramps to that of the reference. At t + T the arm is where the
   reference is now: this is the policy's observation, and u changes it at once, as in the paper.

CLIK closes its loop on the *commanded* joints: no delay can make it unstable. The encoder measures
the pendulum relative to the flange; the flange's own rotation about the spindle is added.

Training, evaluation and deployment run these kernels, on blocks of lanes
(`equipoise.model.elementary`); a rig uses one lane.
"""

from math import floor, pi
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array
from equipoise.control.clik import (
    GAMMA,
    REFERENCE_SIZE,
    ClikParameters,
    joint_acceleration,
    manipulability,
    pose_error,
    solve,
)
from equipoise.control.estimator import Gains, observer_gains
from equipoise.errors import ArmError, SettingsError
from equipoise.jit import called, inlined, kernel
from equipoise.model.actuator import (
    CYCLE,
    IDEAL,
    Actuator,
    ActuatorParameters,
    DelayedSetpoint,
    follow_setpoint,
    lag_share,
    steady_error,
)
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.arms.compiler import FRAME_SIZE, POSITION, ROTATION, TWIST, KinematicsFunction
from equipoise.model.elementary import BATCH_SIZE, at, put, zeros
from equipoise.model.pendulum import PendulumParameters, runge_kutta
from equipoise.settings import Settings

CORRECTION: Final = 0.1
"""Share of the difference between measured and modelled joints that is corrected per tick: a
time constant of 0.1 s. The model is faster than the measurement; only slow differences, such
as the sag under the pendulum's weight, are significant."""
SINGULAR_SHARE: Final = 0.05
"""Share of the manipulability at home below which the inverse is damped."""
DAMPING: Final = 0.05
"""Damping factor at a singularity."""
MIN_MANIPULABILITY: Final = 1e-6
"""Minimum |det J| of a home posture [m^3]; an iiwa at home has 0.09."""
POSE_ITERATIONS: Final = 20
"""Maximum number of Newton steps to a posture."""
POSE_TOLERANCE: Final = 1e-12
"""Pose error at which they end [m], [rad]."""

SETPOINTS_PER_TICK: Final = 2
"""Setpoints per tick: at 100 Hz a servo with a shaping law would move the joints in bursts of four
times their mean speed, at 200 Hz of twice."""
HISTORY_TICKS: Final = 12
"""Number of ticks of the arm's motion in the history."""
MIN_PREDICTION_STEP: Final = 1e-9
"""Duration below which a step of the prediction is skipped [s]."""

PIVOT_V, FLANGE_X, TILT, MODEL_Q = range(4)
"""First rows of the history, for each tick."""
HISTORY_ROWS: Final = MODEL_Q + FREE_JOINTS
"""Rows of the history, for each tick."""
EST_PHI, EST_PHI_DOT, EST_BIAS, EST_PIVOT_V, EST_X = range(5)
"""Rows of the estimate."""
OBS_X, OBS_X_DOT, OBS_PHI, OBS_PHI_DOT = range(4)
"""Rows of the observation."""


class ControllerParams(NamedTuple):
    """Constants of the controller, from `make_controller_params`."""

    kinematics: KinematicsFunction
    """The arm's kinematics."""
    motion: KinematicsFunction
    """The same without J and J_dot dq."""
    clik: ClikParameters
    """Gains and damping."""
    limits: Array
    """Lower, upper, velocity and acceleration limits of the free joints, shape (4, 6)."""
    home: Array
    """Free joints at x = 0 [rad], shape (6,)."""
    home_reference: Array
    """Pose of the flange at home, at rest, as a reference, shape (24,)."""
    pivot: tuple[float, float, float]
    """The pendulum's pivot in the flange frame [m]."""
    h: float
    """Time between ticks [s]."""
    has_sensor: bool
    """Whether a sensor and an actuator are modelled; otherwise the state is measured exactly."""
    actuator: ActuatorParameters
    """The model of the arm."""
    lags: Array
    """Time constant of each free joint [s], shape (6,)."""
    share: Array
    """`lag_share` of each, a block of 6 rows."""
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
    """Share of the difference between measured and modelled q that is corrected per tick [-]."""


class ControllerState(NamedTuple):
    """State of the controllers of `BATCH_SIZE` lanes; each field is a block of rows."""

    q: Array
    """Commanded free joints [rad], 6 rows."""
    dq: Array
    """Their velocities [rad/s], 6 rows."""
    ddq: Array
    """Their accelerations over the last tick [rad/s^2], 6 rows."""
    frame: Array
    """Record of the kinematics at q, dq."""
    reference: Array
    """Record of the flange's reference."""
    e: Array
    """Scratch for the pose error, 6 rows."""
    noise: Array
    """Disturbance of the pose error in the next command [m], [rad], 6 rows; zero on a rig."""
    u: Array
    """Acceleration for the next command [m/s^2], 1 row."""
    setpoints: Array
    """Joints to send at the tick and h / 2 later [rad], 12 rows."""
    limit_exceeded: npt.NDArray[np.int64]
    """Whether the last command left the limits of a joint, 1 row."""
    damped: npt.NDArray[np.int64]
    """Number of damped inverses near a singularity, in all lanes, shape (1,)."""
    counts: Array
    """Measurement: encoder counts, 1 row."""
    measured: Array
    """Measurement: free joints [rad], 6 rows."""
    model_q: Array
    """Modelled free joints at t + d [rad], 6 rows."""
    model_dq: Array
    """Their velocities [rad/s], 6 rows."""
    model_frame: Array
    """Position, rotation and twist of the flange there."""
    offset: Array
    """Measured minus modelled joints, slowly varying [rad], 6 rows."""
    scratch: Array
    """Scratch for joints and their velocities, 12 rows."""
    history: Array
    """Motion of the model at the last `HISTORY_TICKS` ticks: pivot velocity [m/s], flange x [m],
    rotation of the flange about the spindle [rad], joints [rad]."""
    newest: npt.NDArray[np.int64]
    """Index of the newest of these ticks, shape (1,)."""
    estimate: Array
    """phi [rad], phi_dot [rad/s], bias of phi [rad], velocity of the pivot [m/s], flange x [m] at
    the tick, 5 rows."""
    observation: Array
    """Observation of the policy: x [m], x_dot [m/s], phi [rad], phi_dot [rad/s], 4 rows."""


def make_controller_params(
    arm: Arm,
    settings: Settings,
    actuator: Actuator,
    pendulum: PendulumParameters,
    *,
    h: float,
    counts_per_rev: int,
    has_sensor: bool = True,
) -> ControllerParams:
    """Return the constants of a controller.

    Args:
        arm: The arm with its home posture.
        settings: The sections `clik` and `controller`.
        actuator: The model of the arm's response.
        pendulum: Nominal parameters.
        h: Time between ticks [s].
        counts_per_rev: Encoder counts per revolution, after x4.
        has_sensor: Whether a sensor and an actuator are modelled.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay is longer than the history.
    """
    compiled = arm.compiled()
    q, frame = np.zeros(FREE_JOINTS * BATCH_SIZE), np.zeros(FRAME_SIZE * BATCH_SIZE)
    q[::BATCH_SIZE] = arm.home_free
    compiled.kinematics(q, np.zeros(FREE_JOINTS * BATCH_SIZE), frame, 1)
    w = float(manipulability(frame, 0))
    if w < MIN_MANIPULABILITY:
        raise ArmError(
            f"the home posture of {arm.name} is singular (|det J| = {w:.1e} m^3); choose another"
        )
    max_delay = (HISTORY_TICKS - 3) * h
    if actuator.delay.value > max_delay:
        raise SettingsError(
            f"the actuator's delay is {1e3 * actuator.delay.value:.0f} ms, expected at most "
            f"{1e3 * max_delay:.0f} ms, the controller's history; shorten the delay of the link"
        )
    wrist_x, wrist_y, wrist_z = (float(value) for value in compiled.wrist)
    own, clik = settings.controller, settings.clik
    lags = np.array([lag.value for lag in actuator.lags])
    return ControllerParams(
        kinematics=compiled.kinematics,
        motion=compiled.motion,
        clik=ClikParameters(
            clik.K_p, clik.K_d, SINGULAR_SHARE * w, DAMPING, (wrist_x, wrist_y, wrist_z)
        ),
        limits=np.array(
            [compiled.lower, compiled.upper, compiled.max_velocity, compiled.max_acceleration]
        ),
        home=arm.home_free,
        home_reference=frame[: REFERENCE_SIZE * BATCH_SIZE : BATCH_SIZE].copy(),
        pivot=arm.pivot,
        h=h,
        has_sensor=has_sensor,
        actuator=actuator.parameters,
        lags=lags,
        share=np.repeat([float(lag_share(lag)) for lag in lags.tolist()], BATCH_SIZE),
        delay=actuator.delay.value,
        horizon=horizon(arm, actuator, own.margin) if own.predict else 0.0,
        pendulum=pendulum,
        gains=observer_gains(pendulum, counts_per_rev, h, estimate_bias=own.estimate_bias),
        resolution=2.0 * pi / counts_per_rev,
        correction=CORRECTION,
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


def new_controller_state() -> ControllerState:
    """Return the state of controllers before `start_controller`."""
    rows = {
        "frame": FRAME_SIZE,
        "reference": REFERENCE_SIZE,
        "u": 1,
        "setpoints": 6 * SETPOINTS_PER_TICK,
        "counts": 1,
        "model_frame": FRAME_SIZE,
        "scratch": 2 * FREE_JOINTS,
        "history": HISTORY_TICKS * HISTORY_ROWS,
        "estimate": 5,
        "observation": 4,
    }
    whole = {"limit_exceeded": BATCH_SIZE, "damped": 1, "newest": 1}
    blocks: dict[str, Any] = {
        name: np.zeros(whole[name], np.int64)
        if name in whole
        else zeros(rows.get(name, FREE_JOINTS) * BATCH_SIZE)
        for name in ControllerState._fields
    }
    return ControllerState(**blocks)


@kernel
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
    # Newton's method places the arm, in the first lane of separate blocks.
    q, dq, dy = np.zeros(6 * BATCH_SIZE), np.zeros(6 * BATCH_SIZE), np.zeros(6 * BATCH_SIZE)
    e, frame = np.zeros(6 * BATCH_SIZE), np.zeros(FRAME_SIZE * BATCH_SIZE)
    reference = np.zeros(REFERENCE_SIZE * BATCH_SIZE)
    for i in range(REFERENCE_SIZE):
        put(reference, i, 0, controller.home_reference[i])
        put(state.reference, i, n, controller.home_reference[i])
    for i in range(6):
        put(q, i, 0, controller.home[i])
    put(reference, POSITION, 0, controller.home_reference[POSITION] + x)
    for _ in range(POSE_ITERATIONS):
        controller.kinematics(q, dq, frame, 1)
        error = pose_error(frame, reference, 0)
        largest = 0.0
        for i in range(6):
            put(e, i, 0, error[i])
            largest = max(largest, abs(error[i]))
        if largest < POSE_TOLERANCE:
            break
        solve(frame, e, controller.clik, dy, 1)
        q += dy
    e[:] = 0.0
    put(e, 0, 0, x_dot)
    solve(frame, e, controller.clik, dq, 1)
    controller.kinematics(q, dq, frame, 1)
    for i in range(6):
        put(state.q, i, n, at(q, i, 0))
        put(state.dq, i, n, at(dq, i, 0))
        put(state.ddq, i, n, 0.0)
    for i in range(FRAME_SIZE):
        put(state.frame, i, n, at(frame, i, 0))
    put(state.reference, POSITION, n, at(reference, POSITION, 0))
    put(state.reference, TWIST, n, x_dot)


@called
def start_controller(
    controller: ControllerParams,
    state: ControllerState,
    x: float,
    x_dot: float,
    phi: float,
    phi_dot: float,
    n: int,
) -> None:
    """Start lane `n` with an arm that moves steadily and the measured pendulum.

    Args:
        controller: Constants.
        state: Changed in place.
        x: Displacement of the flange from home along base x [m].
        x_dot: Its velocity [m/s].
        phi: Measured angle of the pendulum from upright [rad].
        phi_dot: Measured angular velocity [rad/s].
        n: Lane.
    """
    place_command(controller, state, x, x_dot, n)
    state.limit_exceeded[n] = 0
    h = controller.h
    for i in range(6):
        dq = at(state.dq, i, n)
        q = at(state.q, i, n) - steady_error(dq, controller.lags[i], controller.actuator)
        put(state.model_q, i, n, q)
        put(state.model_dq, i, n, dq)
        put(state.offset, i, n, 0.0)
        for j in range(HISTORY_TICKS):
            entry = _entry(state.newest[0], j)
            put(state.history, entry + MODEL_Q + i, n, q - j * h * dq)
    for j in range(HISTORY_TICKS):
        entry = _entry(state.newest[0], j)
        put(state.history, entry + PIVOT_V, n, x_dot)
        put(state.history, entry + FLANGE_X, n, x - j * h * x_dot)
        put(state.history, entry + TILT, n, 0.0)
    for row, value in enumerate((phi, phi_dot, 0.0, x_dot, x)):
        put(state.estimate, row, n, value)
    # The arm moves steadily: over the horizon the pendulum falls by itself.
    phi, phi_dot = runge_kutta(phi, phi_dot, 0.0, controller.horizon, 0.0, controller.pendulum)
    for row, value in enumerate((x, x_dot, phi, phi_dot)):
        put(state.observation, row, n, value)


@inlined
def _entry(newest: int, j: int) -> int:
    """Return the first row of the motion `j` ticks before the newest."""
    return ((newest - j) % HISTORY_TICKS) * HISTORY_ROWS


@inlined
def _wrapped(angle: float) -> float:
    """Return an angle in [-pi, pi)."""
    return angle - 2.0 * pi * floor((angle + pi) / (2.0 * pi))


@inlined
def observe(
    controller: ControllerParams,
    state: ControllerState,
    encoder_age: float,
    reply_age: float,
    lanes: int,
) -> None:
    """Compute the observations from the measurements in `state`, in the first lanes.

    Args:
        controller: Constants.
        state: Reads `counts` and `measured`; changed in place.
        encoder_age: Age of the counts [s].
        reply_age: Age of the measured joints [s].
        lanes: Number of lanes.
    """
    past, newest = state.history, state.newest[0]
    estimate, obs = state.estimate, state.observation
    measured, offset, counts, frame = state.measured, state.offset, state.counts, state.frame
    h, delay, pendulum = controller.h, controller.delay, controller.pendulum
    on_phi, on_phi_dot, on_bias = controller.gains
    resolution, correction = controller.resolution, controller.correction

    back = (delay + reply_age) / h
    near, far, f = _entry(newest, int(back)), _entry(newest, int(back) + 1), back - int(back)
    for i in range(6):
        for n in range(lanes):
            model = at(past, near + MODEL_Q + i, n)
            model += f * (at(past, far + MODEL_Q + i, n) - model)
            old = at(offset, i, n)
            put(offset, i, n, old + correction * (at(measured, i, n) - model - old))

    back = (delay + encoder_age) / h
    near, far, f = _entry(newest, int(back)), _entry(newest, int(back) + 1), back - int(back)
    for n in range(lanes):
        tilt = at(past, near + TILT, n)
        turned = at(past, far + TILT, n) - tilt
        # Scratch for the angle in space that the encoder shows, until the estimate is made.
        put(obs, OBS_PHI, n, pi - at(counts, 0, n) * resolution + tilt + f * turned)
    whole = int(delay / h)
    near, far, f = _entry(newest, whole), _entry(newest, whole + 1), delay / h - whole
    for n in range(lanes):
        v = at(past, near + PIVOT_V, n)
        v += f * (at(past, far + PIVOT_V, n) - v)
        u = (v - at(estimate, EST_PIVOT_V, n)) / h
        phi, phi_dot = runge_kutta(
            at(estimate, EST_PHI, n), at(estimate, EST_PHI_DOT, n), u, h, 0.0, pendulum
        )
        bias = at(estimate, EST_BIAS, n)
        surprise = _wrapped(at(obs, OBS_PHI, n) - bias - phi + encoder_age * phi_dot)
        phi += on_phi * surprise
        phi_dot += on_phi_dot * surprise
        put(estimate, EST_PHI, n, phi)
        put(estimate, EST_PHI_DOT, n, phi_dot)
        put(estimate, EST_BIAS, n, bias + on_bias * surprise)
        put(estimate, EST_PIVOT_V, n, v)
        put(obs, OBS_PHI, n, phi)
        put(obs, OBS_PHI_DOT, n, phi_dot)
        put(obs, OBS_X_DOT, n, v)
        x = at(past, near + FLANGE_X, n)
        x += f * (at(past, far + FLANGE_X, n) - x)
        put(estimate, EST_X, n, x)
        put(obs, OBS_X, n, x)
    if controller.horizon == 0.0:
        return
    part = delay - whole * h
    for j in range(whole, -1, -1):
        if part > MIN_PREDICTION_STEP:
            to = _entry(newest, j)
            for n in range(lanes):
                _propagate(obs, at(past, to + PIVOT_V, n), part, pendulum, n)
        part = h
    part = controller.horizon - delay
    home_x = controller.home_reference[POSITION]
    if part > MIN_PREDICTION_STEP:
        for n in range(lanes):
            _propagate(obs, at(frame, TWIST, n), part, pendulum, n)
    for n in range(lanes):
        put(obs, OBS_X, n, at(frame, POSITION, n) - home_x)
        put(obs, OBS_X_DOT, n, at(frame, TWIST, n))


@inlined
def _propagate(obs: Array, v: float, time: float, pendulum: PendulumParameters, n: int) -> None:
    """Propagate the predicted pendulum of lane `n` while the pivot velocity ramps to `v`."""
    u = (v - at(obs, OBS_X_DOT, n)) / time
    phi, phi_dot = at(obs, OBS_PHI, n), at(obs, OBS_PHI_DOT, n)
    phi, phi_dot = runge_kutta(phi, phi_dot, u, time, 0.0, pendulum)
    put(obs, OBS_PHI, n, phi)
    put(obs, OBS_PHI_DOT, n, phi_dot)
    put(obs, OBS_X_DOT, n, v)


@inlined
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
    beyond, h, limits = state.limit_exceeded, controller.h, controller.limits
    for n in range(lanes):
        e0, e1, e2, e3, e4, e5 = pose_error(frame, reference, n)
        put(e, 0, n, e0 + at(noise, 0, n))
        put(e, 1, n, e1 + at(noise, 1, n))
        put(e, 2, n, e2 + at(noise, 2, n))
        put(e, 3, n, e3 + at(noise, 3, n))
        put(e, 4, n, e4 + at(noise, 4, n))
        put(e, 5, n, e5 + at(noise, 5, n))
        put(reference, GAMMA, n, u[n])
    state.damped[0] += joint_acceleration(frame, reference, e, controller.clik, ddq, lanes)
    for n in range(lanes):
        move = at(reference, TWIST, n) * h + 0.5 * u[n] * h * h
        put(reference, POSITION, n, at(reference, POSITION, n) + move)
        put(reference, TWIST, n, at(reference, TWIST, n) + u[n] * h)
    if lanes == 1:
        _advance_joints(q, dq, ddq, setpoints, h, BATCH_SIZE)
    else:
        _advance_joints(q, dq, ddq, setpoints, h, 1)
    for n in range(lanes):
        within = True
        for i in range(6):
            angle = at(q, i, n)
            slow = (abs(at(dq, i, n)) <= limits[2, i]) & (abs(at(ddq, i, n)) <= limits[3, i])
            within &= (limits[0, i] <= angle) & (angle <= limits[1, i]) & slow
        beyond[n] = 0 if within else 1
    controller.kinematics(q, dq, frame, lanes)
    if controller.has_sensor:
        advance_arm_model(controller, state, lanes)


@inlined
def _advance_joints(q: Array, dq: Array, ddq: Array, setpoints: Array, h: float, step: int) -> None:
    """Advance the commanded joints by one tick, and write their setpoints.

    Args:
        q: Joints [rad], a block of 6 rows, changed in place.
        dq: Their velocities [rad/s], a block of 6 rows, changed in place.
        ddq: Their accelerations [rad/s^2], a block of 6 rows.
        setpoints: Receives the joints in the middle and at the end of the tick [rad], 12 rows.
        h: Length of the tick [s].
        step: 1 to advance all lanes, `BATCH_SIZE` to advance the first one.
    """
    # Flat loops over adjacent numbers with few arrays: a compiler vectorises no loop over many.
    count = FREE_JOINTS * BATCH_SIZE
    for i in range(0, count, step):
        a, v, angle = ddq[i], dq[i], q[i]
        setpoints[i] = angle + 0.5 * v * h + 0.125 * a * h * h
        setpoints[count + i] = angle + (v * h + 0.5 * a * h * h)
    for i in range(0, count, step):
        q[i] = setpoints[count + i]
        dq[i] = dq[i] + ddq[i] * h


@inlined
def advance_arm_model(controller: ControllerParams, state: ControllerState, lanes: int) -> None:
    """Advance the model of the arm to the end of the tick, and record its motion.

    Args:
        controller: Constants.
        state: Changed in place.
        lanes: Number of lanes.
    """
    scratch, past, frame = state.scratch, state.history, state.model_frame
    q, dq, share = state.model_q, state.model_dq, controller.share
    velocity = scratch[FREE_JOINTS * BATCH_SIZE :]
    cycles = round(controller.h / SETPOINTS_PER_TICK / CYCLE)
    for s in range(SETPOINTS_PER_TICK):
        target = state.setpoints[6 * s * BATCH_SIZE : 6 * (s + 1) * BATCH_SIZE]
        setpoint = DelayedSetpoint(target, target, share, False)
        follow_setpoint(q, dq, setpoint, share, controller.actuator, cycles, scratch, lanes)
    if controller.actuator.kind == IDEAL:
        # It jumps to each setpoint and then rests; the motion is that of the command.
        for i in range(FREE_JOINTS * BATCH_SIZE):
            velocity[i] = state.dq[i]
    state.newest[0] = (state.newest[0] + 1) % HISTORY_TICKS
    entry = _entry(state.newest[0], 0)
    for i in range(6):
        for n in range(lanes):
            angle = at(q, i, n)
            put(past, entry + MODEL_Q + i, n, angle)
            put(scratch, i, n, angle + at(state.offset, i, n))
    controller.motion(scratch, velocity, frame, lanes)
    home_x = controller.home_reference[POSITION]
    for n in range(lanes):
        put(past, entry + PIVOT_V, n, pivot_velocity(frame, controller.pivot, n))
        put(past, entry + FLANGE_X, n, at(frame, POSITION, n) - home_x)
        put(past, entry + TILT, n, -pose_error(frame, state.reference, n)[4])


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
    y = at(frame, r + 3, n) * px + at(frame, r + 4, n) * py + at(frame, r + 5, n) * pz
    z = at(frame, r + 6, n) * px + at(frame, r + 7, n) * py + at(frame, r + 8, n) * pz
    return at(frame, TWIST, n) + at(frame, TWIST + 4, n) * z - at(frame, TWIST + 5, n) * y


@called
def copy_controller_state(state: ControllerState, source: int, target: int) -> None:
    """Copy the state of one lane to another, to close the gap of a finished one."""
    commanded = state.q, state.dq, state.ddq, state.frame, state.reference, state.setpoints
    modelled = state.model_q, state.model_dq, state.offset, state.history
    observed = state.estimate, state.observation
    for block in commanded + modelled + observed:
        copy_rows(block, source, target)
    state.limit_exceeded[target] = state.limit_exceeded[source]


@called
def copy_rows(block: Any, source: int, target: int) -> None:
    """Copy one lane of a block to another, in all of its rows."""
    for row in range(len(block) // BATCH_SIZE):
        block[row * BATCH_SIZE + target] = block[row * BATCH_SIZE + source]
