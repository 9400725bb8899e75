"""Closed loop: one control step of controller, arm and pendulum.

A step takes h = 0.01 s: u -> CLIK -> joint motion -> tracked acceleration u' -> pendulum. The
reference moves along base x only; u' is the change of the velocity of the pendulum's pivot along x
over the step, divided by h, and drives the pendulum (section 3.2). Noise is the paper's: on I and b
once per episode, on the pose error e in every step.

With the paper's actuator `ideal` the arm follows each setpoint at once and the state is known. With
any other the setpoints take effect after a delay, each joint through servo and drive; an encoder
with a zero error counts; and the policy receives the controller's observation
(`equipoise.control.control_step`). Delay, lags and zero error vary between episodes.

Kernels advance a block of independent states at once, one per lane (`equipoise.elementary`);
a lane's result does not depend on the others. Training, evaluation, recorded runs and Python
policies all call the `step` below.
"""

from collections.abc import Sequence
from math import floor, inf, pi
from typing import Annotated, Final, NamedTuple, Protocol

from equipoise import paper
from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arm.clik import pose_error
from equipoise.arm.compiler import FRAME_SIZE, POSITION, TWIST
from equipoise.arrays import Array, IntArray
from equipoise.control.control_step import (
    LANES,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    Observed,
    kinematics,
    make_controller_params,
    pivot_velocity,
    wrapped,
)
from equipoise.control.policy import Observation
from equipoise.control.swing_up import SwingUpState
from equipoise.elementary import BATCH_SIZE, sincos
from equipoise.jit import call, compilable, inlined, pointer
from equipoise.model.actuator import (
    CYCLE,
    ROWS,
    Actuator,
    Servos,
    follow,
    lag_fraction,
    motion_of,
    steady_error,
)
from equipoise.model.grid import ANGLE, JOINT_LIMIT, SAFETY_STOP, TRACK, TRUNCATED, Grid, box_index
from equipoise.model.pendulum import PendulumParameters, runge_kutta
from equipoise.model.pendulum import step as pendulum_step
from equipoise.model.random import normal_radius, philox, turn, uniform
from equipoise.safety.rules import SPEED_CODE
from equipoise.settings import Settings

SETPOINTS_IN_FLIGHT: Final = 32
"""Number of setpoints that may be in flight to the arm."""


class LoopParams(NamedTuple):
    """Constants of the closed loop during an episode."""

    controller: ControllerParams
    """Controller: u to setpoints, measurements to observations."""
    max_speed: float
    """Limit of the flange's speed [m/s]; inf without a limit."""
    position_noise: float
    """Standard deviation of the noise on the position part of e [m]."""
    orientation_noise: float
    """Standard deviation of the noise on the orientation part of e [rad]."""
    reset: int = 0
    """Address of the compiled `reset`."""
    step: int = 0
    """Address of the compiled `step`."""


class DomainRandomization(NamedTuple):
    """Deviation of the plant of one episode from the nominal one."""

    inertia_factor: float
    """Factor on the moment of inertia [-]."""
    friction_factor: float
    """Factor on the friction coefficients [-]."""
    delay: float
    """Addition to the transport delay [s]."""
    lag_factor: float
    """Factor on the lags of the joints [-]."""
    zero: float
    """Encoder zero error, added to phi [rad]."""


class Trial(NamedTuple):
    """Conditions of one trial or episode."""

    number: int
    """Its number, which determines all noise together with the seed."""
    start: tuple[float, float, float, float]
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release."""
    variation: DomainRandomization
    """Difference of the plant from the nominal one."""


@inlined
def trial_of(number: int, start: Sequence[float], variation: Sequence[float]) -> Trial:
    """Return a trial of its number, its start and the fields of its `DomainRandomization`."""
    x, x_dot, phi, phi_dot = start
    inertia, friction, delay, lag, zero = variation
    varied = DomainRandomization(inertia, friction, delay, lag, zero)
    return Trial(number, (x, x_dot, phi, phi_dot), varied)


class Pendula(Protocol):
    """Numbers of `PendulumParameters`."""

    w2: Annotated[Array, LANES]
    k: Annotated[Array, LANES]
    c: Annotated[Array, LANES]
    coulomb: Annotated[Array, LANES]
    drag: Annotated[Array, LANES]


class BatchState(Protocol):
    """States of `BATCH_SIZE` closed loops; kernels change them in place."""

    controller: ControllerState
    """States of the controllers."""
    swing_up: SwingUpState
    """States of the swing-ups."""
    pendula: Pendula
    """Parameters of the pendulums."""
    state: Observed
    """True states."""
    time: Annotated[Array, LANES]
    """Time since the release [s]; a rule may end a trial within a tick."""
    pivot_v: Annotated[Array, LANES]
    """Velocity of the pivot along x before the step [m/s]."""
    u_tracked: Annotated[Array, LANES]
    """Tracked acceleration u' of the last step [m/s^2]."""
    cycle_pivot_v: Annotated[Array, LANES]
    """Velocity of the pivot along x before a servo cycle [m/s]; with dry friction."""
    cycle_u: Annotated[Array, LANES]
    """Tracked acceleration of a servo cycle [m/s^2]; with dry friction."""
    cause: Annotated[IntArray, LANES]
    """Cause of failure in the last step."""
    arm: Servos
    """Arms. An ideal actuator leaves this and the following fields unused: its joints are the
    commanded ones."""
    frame: Annotated[Array, (FRAME_SIZE, BATCH_SIZE)]
    """Kinematics at their joints: position, orientation and twist of the flange."""
    setpoints: Annotated[Array, (SETPOINTS_IN_FLIGHT, *ROWS)]
    """Last setpoints [rad]."""
    delay: Annotated[IntArray, LANES]
    """Whole setpoints of the transport delay."""
    zero: Annotated[Array, LANES]
    """Encoder zero error, added to phi [rad]."""
    newest: Annotated[IntArray, LANES]
    """Index of the newest setpoint, equal in all lanes."""


def make_loop_params(
    arm: Arm, settings: Settings, h: float, pendulum: PendulumParameters, actuator: Actuator
) -> LoopParams:
    """Return the constants of a plant for compiled loops.

    Args:
        arm: The arm with its home posture.
        settings: Gains, controller and noise.
        h: Time step [s].
        pendulum: Nominal pendulum, which the controller assumes and episodes vary.
        actuator: Arm response of the controller's model; episodes vary about it.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay exceeds the controller's history.
    """
    plant = LoopParams(
        controller=make_controller_params(
            arm, settings, actuator, pendulum, h=h, has_sensor=actuator.kind != "ideal"
        ),
        max_speed=settings.plant.max_speed or inf,
        position_noise=settings.plant.position_error_sigma,
        orientation_noise=settings.plant.orientation_error_sigma,
    )
    trial = trial_of(0, (0.0,) * 4, (1.0, 1.0, 0.0, 1.0, 0.0))
    return plant._replace(
        reset=pointer(reset, plant, BatchState, trial, 0), step=pointer(step, plant, BatchState, 0)
    )


def reset(plant: LoopParams, batch: BatchState, trial: Trial, n: int) -> None:
    """Place lane `n` at the start of a trial, the arm in steady motion on its track.

    Args:
        plant: Constants.
        batch: Changed in place.
        trial: Start and plant of this lane until its next reset.
        n: Lane.
    """
    params, controller, state, arm = plant.controller, batch.controller, batch.state, batch.arm
    (x, x_dot, phi, phi_dot), variation = trial.start, trial.variation
    zero = variation.zero if params.has_sensor else 0.0
    measured = Observation(x, x_dot, phi + zero, phi_dot)
    call(params.start_controller, (params, controller, measured, n))
    own = scaled(params.pendulum, variation)
    pendula = batch.pendula
    pendula.w2[n], pendula.k[n], pendula.c[n] = own.w2, own.k, own.c
    pendula.coulomb[n], pendula.drag[n] = own.coulomb, own.drag
    state.x[n] = controller.frame[POSITION, n] - params.home_reference[POSITION]
    state.x_dot[n] = controller.frame[TWIST, n]
    state.phi[n], state.phi_dot[n], batch.u_tracked[n] = phi, phi_dot, 0.0
    batch.cause[n] = TRUNCATED
    if not params.has_sensor:
        return
    delay = max(params.delay + variation.delay, 0.0)
    batch.zero[n] = zero
    apart = params.h / SETPOINTS_PER_TICK
    cycles, delayed = round(apart / CYCLE), round(delay / CYCLE)
    batch.delay[n] = delayed // cycles
    for i in range(FREE_JOINTS):
        q, dq = controller.q[i, n], controller.dq[i, n]
        lag = params.lags[i] * variation.lag_factor
        behind = dq * delay + steady_error(dq, lag, params.actuator)
        arm.q[i, n], arm.dq[i, n], arm.fraction[i, n] = q - behind, dq, lag_fraction(lag)
        for j in range(SETPOINTS_IN_FLIGHT):
            batch.setpoints[(batch.newest[0] - j) % SETPOINTS_IN_FLIGHT, i, n] = q - j * apart * dq
        arm.turn[i, n] = float(delayed % cycles)
        arm.target[i, n] = q - batch.delay[n] * apart * dq
    for i in range(FRAME_SIZE):
        batch.frame[i, n] = controller.frame[i, n]


def step(plant: LoopParams, batch: BatchState, lanes: int) -> None:
    """Advance controller, arm and pendulum of the first lanes by one time step.

    Reads u and standard normal numbers of the controller's state, and updates everything else in
    the batch. `cause` becomes each lane's cause of failure, or `TRUNCATED`.

    Args:
        plant: Constants.
        batch: Changed in place.
        lanes: Number of lanes.
    """
    params, controller, state, cause = plant.controller, batch.controller, batch.state, batch.cause
    noise, h, home_x = controller.noise, params.h, params.home_reference[POSITION]
    for i in range(6):
        sigma = plant.position_noise if i < 3 else plant.orientation_noise
        for n in range(BATCH_SIZE):
            noise[i, n] *= sigma
    frame = batch.frame if params.has_sensor else controller.frame
    for n in range(BATCH_SIZE):
        batch.pivot_v[n] = pivot_velocity(frame, params.pivot, n)
    call(params.command, (params, controller, lanes))
    dry = False
    for n in range(lanes):
        dry = dry or batch.pendula.coulomb[n] > 0.0
    # Dry friction depends on the sign of the rate, which the vibration of a pivot behind an
    # actuator changes within a step: there such pendulums advance cycle by cycle.
    by_cycles = params.has_sensor and dry
    if by_cycles:
        move_arms_and_pendula(params, batch, lanes)
    elif params.has_sensor:
        move_arms(params, batch, lanes)
    for n in range(BATCH_SIZE):
        v = pivot_velocity(frame, params.pivot, n)
        batch.u_tracked[n] = (v - batch.pivot_v[n]) / h
        state.x[n] = frame[POSITION, n] - home_x
        state.x_dot[n] = frame[TWIST, n]
    if not by_cycles:
        advance_pendula(batch, batch.u_tracked, h, params.pendulum.linearised, dry, lanes)
    for n in range(BATCH_SIZE):
        exceeded = controller.limit_exceeded[n] != 0
        state.phi[n] = wrapped(state.phi[n])
        balancing = controller.balancing[n] != 0
        cause[n] = failure(observed(state, n), exceeded, plant.max_speed, balancing)
    if params.has_sensor:
        measure(params, batch)
        call(params.observe, (params, controller, (0.0, 0.0), lanes))
    else:
        seen = controller.observation
        for n in range(BATCH_SIZE):
            seen.x[n], seen.x_dot[n] = state.x[n], state.x_dot[n]
            seen.phi[n], seen.phi_dot[n] = state.phi[n], state.phi_dot[n]


@inlined
def failure(state: Observation, limit_exceeded: bool, max_speed: float, balancing: bool) -> int:
    """Return the cause of the failure of a state, `TRUNCATED` without one; NaN is a failure.

    Args:
        state: The true state.
        limit_exceeded: Whether the last command exceeded a limit of a joint.
        max_speed: Limit of the flange's speed [m/s].
        balancing: Whether the failure angle applies; not in a swing-up.
    """
    phi_limit = paper.PHI_LIMIT if balancing else inf
    # The cause of a speed is that of the guard of a rig.
    within = TRUNCATED if abs(state.x_dot) < max_speed else SAFETY_STOP + SPEED_CODE
    within = JOINT_LIMIT if limit_exceeded else within
    on_track = within if abs(state.x) < paper.X_LIMIT else TRACK
    return on_track if abs(state.phi) < phi_limit else ANGLE


@inlined
def move_arms(params: ControllerParams, batch: BatchState, lanes: int) -> None:
    """Send the setpoints of the tick, and move the arms of the first lanes by one tick."""
    arm, cycles = batch.arm, round(params.h / SETPOINTS_PER_TICK / CYCLE)
    for s in range(SETPOINTS_PER_TICK):
        _send(batch, s, lanes)
        call(params.follow_setpoint, (arm, params.actuator, cycles, True, lanes))
    velocity = motion_of(arm, params.actuator)
    kinematics(params.motion, arm.q, velocity, batch.frame, lanes)


@inlined
def move_arms_and_pendula(params: ControllerParams, batch: BatchState, lanes: int) -> None:
    """Move arms and pendulums of the first lanes by one tick, cycle by cycle."""
    arm, frame, cycles = batch.arm, batch.frame, round(params.h / SETPOINTS_PER_TICK / CYCLE)
    linearised = params.pendulum.linearised
    for s in range(SETPOINTS_PER_TICK):
        _send(batch, s, lanes)
        for cycle in range(cycles):
            for n in range(BATCH_SIZE):
                batch.cycle_pivot_v[n] = pivot_velocity(frame, params.pivot, n)
            follow(arm, params.actuator, cycle, lanes)
            kinematics(params.motion, arm.q, arm.dq, frame, lanes)
            for n in range(BATCH_SIZE):
                v = pivot_velocity(frame, params.pivot, n)
                batch.cycle_u[n] = (v - batch.cycle_pivot_v[n]) * (1.0 / CYCLE)
            advance_pendula(batch, batch.cycle_u, CYCLE, linearised, True, lanes)


@inlined
def _send(batch: BatchState, s: int, lanes: int) -> None:
    """Send setpoint `s` of the tick, and take the next one that comes into force in each lane."""
    before, target, delay = batch.arm.before, batch.arm.target, batch.delay
    newest = (batch.newest[0] + 1) % SETPOINTS_IN_FLIGHT
    for n in range(BATCH_SIZE):
        batch.newest[n] = newest
    sent = batch.setpoints[newest]
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            sent[i, n] = batch.controller.setpoints[s, i, n]
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            before[i, n] = target[i, n]
    least, most = delay[0], delay[0]
    for n in range(lanes):
        least, most = min(least, delay[n]), max(most, delay[n])
    # The delays of all lanes span few setpoints: whole rows are read for each of them.
    for age in range(least, most + 1):
        old = batch.setpoints[(newest - age) % SETPOINTS_IN_FLIGHT]
        for i in range(FREE_JOINTS):
            for n in range(BATCH_SIZE):
                now, then = target[i, n], old[i, n]
                target[i, n] = then if delay[n] == age else now


@inlined
def measure(params: ControllerParams, batch: BatchState) -> None:
    """Write encoder counts and measured joints to the controllers of all lanes."""
    controller, state, frame = batch.controller, batch.state, batch.frame
    for n in range(BATCH_SIZE):
        tilt = -pose_error(frame, controller.reference, n)[4]
        theta = pi - (state.phi[n] - tilt + batch.zero[n])
        controller.counts[n] = floor(theta * (1.0 / params.resolution) + 0.5)
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            controller.measured[i, n] = batch.arm.q[i, n]


@inlined
def advance_pendula(
    batch: BatchState, u: Array, h: float, linearised: bool, dry: bool, lanes: int
) -> None:
    """Advance the pendulums of the first lanes by one time step.

    Args:
        batch: Changed in place.
        u: Tracked acceleration of each lane [m/s^2].
        h: Length of the step [s].
        linearised: Whether the pendulums are those of equation (7).
        dry: Whether any pendulum has dry friction.
        lanes: Number of lanes.
    """
    phi, phi_dot, pendula = batch.state.phi, batch.state.phi_dot, batch.pendula
    # Dry friction can stop the pendulum within a step: those branches have a loop of their own.
    if dry:
        for n in range(lanes):
            pendulum = pendulum_of(pendula, linearised, n)
            phi[n], phi_dot[n] = pendulum_step(phi[n], phi_dot[n], u[n], h, pendulum)
    else:
        for n in range(BATCH_SIZE):
            pendulum = pendulum_of(pendula, linearised, n)
            phi[n], phi_dot[n] = runge_kutta(phi[n], phi_dot[n], u[n], h, 0.0, pendulum)


@inlined
def pendulum_of(pendula: Pendula, linearised: bool, n: int) -> PendulumParameters:
    """Return the pendulum of lane `n`."""
    w2, k, c = pendula.w2[n], pendula.k[n], pendula.c[n]
    return PendulumParameters(w2, k, c, pendula.coulomb[n], pendula.drag[n], linearised)


@inlined
def draw_noise(
    noise: Array, seed: int, tick: IntArray, index: IntArray, stream: int, lanes: int
) -> None:
    """Write six standard normal numbers for each lane, from `stream` and the one after it.

    Args:
        noise: Receives the numbers, 6 rows.
        seed: Master seed.
        tick: Step of each lane within its episode or trial.
        index: Episode or trial of each lane.
        stream: First of the two streams of random numbers.
        lanes: Number of lanes.
    """
    for n in range(lanes):
        draw_uniform(noise, seed, tick[n], index[n], stream, n)
    to_normal(noise, lanes)


@inlined
def draw_uniform(noise: Array, seed: int, tick: int, index: int, stream: int, n: int) -> None:
    """Write the uniform numbers and angles of lane `n`, from which `to_normal` makes its noise."""
    w0, w1, w2, w3 = philox(seed, tick, index, 0, stream)
    v0, v1, _, _ = philox(seed, tick, index, 0, stream + 1)
    noise[0, n], noise[1, n] = uniform(w0, 1.0, 0.0), turn(w1)
    noise[2, n], noise[3, n] = uniform(w2, 1.0, 0.0), turn(w3)
    noise[4, n], noise[5, n] = uniform(v0, 1.0, 0.0), turn(v1)


@inlined
def to_normal(noise: Array, lanes: int) -> None:
    """Turn the uniform numbers and angles of the first lanes into standard normal numbers."""
    # Loops with few arrays and formulas: a compiler vectorises no large one.
    for i in range(0, 6, 2):
        for n in range(lanes):
            radius = normal_radius(noise[i, n])
            sine, cosine = sincos(noise[i + 1, n])
            noise[i, n] = radius * cosine
            noise[i + 1, n] = radius * sine


@inlined
def copy_lane(rows: IntArray, source: int, target: int) -> None:
    """Copy one lane to another, to fill the gap of a finished one; `rows` from `rows_of`."""
    for i in range(len(rows)):
        rows[i, target] = rows[i, source]


@inlined
def observed(state: Observed, n: int) -> Observation:
    """Return the observation or the true state of lane `n`."""
    return Observation(state.x[n], state.x_dot[n], state.phi[n], state.phi_dot[n])


@inlined
def box_of(seen: Observed, boxes: Grid, n: int) -> int:
    """Return the box of the observation of lane `n`."""
    return box_index(seen.x[n], seen.x_dot[n], seen.phi[n], seen.phi_dot[n], boxes)


@compilable
def scaled(pendulum: PendulumParameters, variation: DomainRandomization) -> PendulumParameters:
    """Return the pendulum with I and b multiplied: I divides everything, b scales c alone.

    Factors come from normal distributions: I keeps at least a tenth of itself, b is not negative.
    """
    I, b = max(variation.inertia_factor, 0.1), max(variation.friction_factor, 0.0)
    w2, k, c, coulomb, drag, linearised = pendulum
    return PendulumParameters(w2 / I, k / I, c * b / I, coulomb / I, drag / I, linearised)
