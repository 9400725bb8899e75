"""Closed loop: one control step of controller, arm and pendulum.

A step takes h = 0.01 s: u -> CLIK -> joint motion -> tracked acceleration u' -> pendulum. The
reference moves along base x only; u' is the change of the velocity of the pendulum's pivot along x
over the step, divided by h, and drives the pendulum (section 3.2). Noise is the paper's: on I and b
once per episode, on the pose error e in every step.

With the paper's actuator `ideal` the arm follows each setpoint at once and the state is known. With
any other the setpoints take effect after a delay, each joint through servo and drive; an encoder
with a zero error counts; and the policy receives the controller's observation
(`equipoise.control.control_step`). Delay, lags and zero error vary between episodes.

Kernels advance a block of independent states at once, one per lane (`equipoise.model.elementary`);
a lane's result does not depend on the others. Training, evaluation, recorded runs and Python
policies all call the `step` below.
"""

from math import floor, inf, pi
from typing import Final, NamedTuple

import numpy as np

from equipoise import paper
from equipoise.arrays import Array, IntArray
from equipoise.control.clik import pose_error
from equipoise.control.control_step import (
    OBS_PHI,
    OBS_PHI_DOT,
    OBS_X,
    OBS_X_DOT,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    command,
    copy_controller_state,
    copy_rows,
    make_controller_params,
    new_controller_state,
    observe,
    pivot_velocity,
    start_controller,
)
from equipoise.control.grid import (
    ANGLE,
    JOINT_LIMIT,
    PHI_LIMIT,
    SAFETY_STOP,
    TRACK,
    TRUNCATED,
    Grid,
    box_index,
)
from equipoise.jit import called, inlined
from equipoise.model.actuator import (
    CYCLE,
    IDEAL_ACTUATOR,
    Actuator,
    DelayedSetpoint,
    aim_at,
    follow,
    follow_setpoint,
    lag_share,
    steady_error,
)
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.arms.compiler import FRAME_SIZE, POSITION, TWIST
from equipoise.model.elementary import BATCH_SIZE, at, put, sincos, zeros
from equipoise.model.pendulum import PendulumParameters, runge_kutta
from equipoise.model.pendulum import step as pendulum_step
from equipoise.model.random import normal_radius, philox, turn, uniform
from equipoise.safety.rules import SPEED_CODE
from equipoise.settings import Settings

MIN_INERTIA_FACTOR: Final = 0.1
"""Smallest factor on the moment of inertia that noise may give [-]."""
SETPOINT_HISTORY: Final = 32
"""Number of setpoints that may be in flight to the arm."""
SPEED_LIMIT_CAUSE: Final = SAFETY_STOP + SPEED_CODE
"""Cause of failure where the task limits the flange's speed: that of the guard of a rig."""

# Rows of the block of states.
X, X_DOT, PHI, PHI_DOT = range(4)
TRACKED: Final = 4
"""Row of the tracked acceleration u' of the last step."""


class LoopParams(NamedTuple):
    """Constants of the closed loop during an episode."""

    controller: ControllerParams
    """Controller: u to setpoints, measurements to observations."""
    phi_limit: float
    """Failure angle |phi| [rad]."""
    x_limit: float
    """Failure displacement |x| [m]."""
    speed_limit: float
    """Failure speed |x_dot| [m/s]; inf without a limit."""
    position_noise: float
    """Standard deviation of the noise on the position part of e [m]."""
    orientation_noise: float
    """Standard deviation of the noise on the orientation part of e [rad]."""
    linearised: bool
    """Whether the pendulum is that of equation (7)."""


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


class BatchState(NamedTuple):
    """States of `BATCH_SIZE` closed loops, changed in place by a step; each field is a block."""

    controller: ControllerState
    """States of the controllers."""
    pendula: Array
    """Numbers of `PendulumParameters`, 5 rows."""
    state: Array
    """x, x_dot, phi, phi_dot, and u' of the last step, in SI units, 5 rows."""
    cause: IntArray
    """Cause of failure in the last step, 1 row."""
    q: Array
    """Free joints of the arm [rad], 6 rows. An ideal actuator leaves this and the following fields
    unused: its joints are the commanded ones."""
    dq: Array
    """Their velocities [rad/s], 6 rows."""
    frame: Array
    """Kinematics at those joints: position, orientation and twist of the flange."""
    share: Array
    """Share of its lag that a joint makes up per servo cycle [-], 6 rows."""
    target: Array
    """Setpoints in force at the end of a tick [rad], 6 rows."""
    before: Array
    """Those in force before them, 6 rows."""
    setpoints: Array
    """Last `SETPOINT_HISTORY` setpoints [rad], 6 rows each."""
    newest: IntArray
    """Index of the newest setpoint, shape (1,)."""
    delay: IntArray
    """IntArray setpoints of the transport delay, 1 row."""
    turn: Array
    """Its other servo cycles, 6 equal rows."""
    zero: Array
    """Encoder zero error, added to phi [rad], 1 row."""


def make_loop_params(
    arm: Arm,
    settings: Settings,
    h: float,
    pendulum: PendulumParameters,
    actuator: Actuator = IDEAL_ACTUATOR,
) -> LoopParams:
    """Return the constants of a plant for compiled loops.

    Args:
        arm: The arm with its home posture.
        settings: Gains, controller and noise.
        h: Time step [s].
        pendulum: Pendulum of the controller's model.
        actuator: Arm response of the controller's model; episodes vary about it.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay exceeds the controller's history.
    """
    max_speed = settings.plant.max_speed
    return LoopParams(
        controller=make_controller_params(
            arm,
            settings,
            actuator,
            pendulum,
            h=h,
            counts_per_rev=settings.plant.counts_per_rev,
            has_sensor=actuator.kind != "ideal",
        ),
        phi_limit=PHI_LIMIT,
        x_limit=paper.X_LIMIT,
        speed_limit=inf if max_speed is None else max_speed,
        position_noise=settings.plant.position_error_sigma,
        orientation_noise=settings.plant.orientation_error_sigma,
        linearised=settings.plant.linearised,
    )


def new_batch_state() -> BatchState:
    """Return a block for `reset`."""

    def rows(count: int) -> Array:
        return zeros(count * BATCH_SIZE)

    return BatchState(
        controller=new_controller_state(),
        pendula=rows(5),
        state=rows(5),
        cause=np.zeros(BATCH_SIZE, np.int64),
        q=rows(6),
        dq=rows(6),
        frame=rows(FRAME_SIZE),
        share=rows(6),
        target=rows(6),
        before=rows(6),
        setpoints=rows(6 * SETPOINT_HISTORY),
        newest=np.zeros(1, np.int64),
        delay=np.zeros(BATCH_SIZE, np.int64),
        turn=rows(6),
        zero=rows(1),
    )


@called
def reset(
    plant: LoopParams,
    block: BatchState,
    pendulum: PendulumParameters,
    variation: DomainRandomization,
    start: tuple[float, float, float, float],
    n: int,
) -> None:
    """Place lane `n` at a state, the arm in steady motion on its track.

    Args:
        plant: Constants.
        block: Changed in place.
        pendulum: Nominal pendulum.
        variation: Deviation of this lane until its next reset.
        start: Displacement of the flange from home along base x [m], its velocity [m/s], angle of
            the pendulum from upright [rad] and its angular velocity [rad/s].
        n: Lane.
    """
    controller, memory = plant.controller, block.controller
    x, x_dot, phi, phi_dot = start
    zero = variation.zero if controller.has_sensor else 0.0
    start_controller(controller, memory, x, x_dot, phi + zero, phi_dot, n)
    own = scaled(pendulum, variation.inertia_factor, variation.friction_factor)
    put(block.pendula, 0, n, own.w2)
    put(block.pendula, 1, n, own.k)
    put(block.pendula, 2, n, own.c)
    put(block.pendula, 3, n, own.coulomb)
    put(block.pendula, 4, n, own.drag)
    put(block.state, X, n, at(memory.frame, POSITION, n) - controller.home_reference[POSITION])
    put(block.state, X_DOT, n, at(memory.frame, TWIST, n))
    put(block.state, PHI, n, phi)
    put(block.state, PHI_DOT, n, phi_dot)
    put(block.state, TRACKED, n, 0.0)
    block.cause[n] = TRUNCATED
    if not controller.has_sensor:
        return
    delay = max(controller.delay + variation.delay, 0.0)
    put(block.zero, 0, n, zero)
    apart = controller.h / SETPOINTS_PER_TICK
    cycles, delayed = round(apart / CYCLE), round(delay / CYCLE)
    block.delay[n] = delayed // cycles
    for i in range(FREE_JOINTS):
        dq, lag = at(memory.dq, i, n), controller.lags[i] * variation.lag_factor
        first = at(memory.q, i, n)
        behind = dq * delay + steady_error(dq, lag, controller.actuator)
        put(block.q, i, n, first - behind)
        put(block.dq, i, n, dq)
        put(block.share, i, n, lag_share(lag))
        for j in range(SETPOINT_HISTORY):
            row = 6 * ((block.newest[0] - j) % SETPOINT_HISTORY)
            put(block.setpoints, row + i, n, first - j * apart * dq)
        put(block.turn, i, n, float(delayed % cycles))
        put(block.target, i, n, first - block.delay[n] * apart * dq)
    for i in range(FRAME_SIZE):
        put(block.frame, i, n, at(memory.frame, i, n))


@called
def step(plant: LoopParams, block: BatchState, lanes: int) -> None:
    """Advance controller, arm and pendulum of the first lanes by one time step.

    Reads u and standard normal numbers of the controller's state, and updates everything else in
    the block. `cause` becomes each lane's cause of failure, or `TRUNCATED`.

    Args:
        plant: Constants.
        block: Changed in place.
        lanes: Number of lanes.
    """
    controller, memory, state, cause = plant.controller, block.controller, block.state, block.cause
    noise, h, home_x = memory.noise, controller.h, controller.home_reference[POSITION]
    for i in range(6):
        sigma = plant.position_noise if i < 3 else plant.orientation_noise
        for n in range(lanes):
            put(noise, i, n, sigma * at(noise, i, n))
    frame = memory.frame
    if controller.has_sensor:
        frame = block.frame
    for n in range(lanes):
        # TRACKED holds minus the pivot velocity before the step, until u' replaces it.
        put(state, TRACKED, n, -pivot_velocity(frame, controller.pivot, n))
    command(controller, memory, lanes)
    dry = False
    for n in range(lanes):
        dry = dry or at(block.pendula, 3, n) > 0.0
    if controller.has_sensor:
        move_arms(controller, block, plant.linearised, dry, lanes)
    for n in range(lanes):
        v = pivot_velocity(frame, controller.pivot, n)
        put(state, TRACKED, n, (v + at(state, TRACKED, n)) / h)
        put(state, X, n, at(frame, POSITION, n) - home_x)
        put(state, X_DOT, n, at(frame, TWIST, n))
    if not (controller.has_sensor and dry):
        advance_pendula(state, block.pendula, h, plant.linearised, lanes)
    for n in range(lanes):
        slow = abs(at(state, X_DOT, n)) < plant.speed_limit
        within = (
            JOINT_LIMIT if memory.limit_exceeded[n] else (TRUNCATED if slow else SPEED_LIMIT_CAUSE)
        )
        on_track = abs(at(state, X, n)) < plant.x_limit
        upright = abs(at(state, PHI, n)) < plant.phi_limit
        cause[n] = (within if on_track else TRACK) if upright else ANGLE
    if controller.has_sensor:
        measure(controller, block, lanes)
        observe(controller, memory, 0.0, 0.0, lanes)
    else:
        for i in range(4):
            for n in range(lanes):
                put(memory.observation, i, n, at(state, i, n))


@inlined
def move_arms(
    controller: ControllerParams, block: BatchState, linearised: bool, dry: bool, lanes: int
) -> None:
    """Send the setpoints of the tick, and move the arms of the first lanes by one tick.

    Dry friction depends on the sign of the rate, which the pivot's vibration within a tick changes:
    pendulums with dry friction advance here, cycle by cycle.

    Args:
        controller: Constants.
        block: Changed in place.
        linearised: Whether the pendulums are those of equation (7).
        dry: Whether any pendulum has dry friction.
        lanes: Number of lanes.
    """
    q, dq, share, actuator = block.q, block.dq, block.share, controller.actuator
    setpoint = DelayedSetpoint(block.before, block.target, block.turn, True)
    state, frame, scratch = block.state, block.frame, block.controller.scratch
    cycles = round(controller.h / SETPOINTS_PER_TICK / CYCLE)
    if not dry:
        for s in range(SETPOINTS_PER_TICK):
            _send(block, s, lanes)
            follow_setpoint(q, dq, setpoint, share, actuator, cycles, scratch, lanes)
        controller.motion(q, scratch[FREE_JOINTS * BATCH_SIZE :], frame, lanes)
        return
    for n in range(lanes):
        put(scratch, FREE_JOINTS, n, at(state, TRACKED, n))
    for s in range(SETPOINTS_PER_TICK):
        _send(block, s, lanes)
        for cycle in range(cycles):
            aim_at(cycle, setpoint, scratch)
            follow(q, dq, scratch, share, actuator, lanes)
            for n in range(lanes):
                put(state, TRACKED, n, -pivot_velocity(frame, controller.pivot, n))
            controller.motion(q, dq, frame, lanes)
            for n in range(lanes):
                v = pivot_velocity(frame, controller.pivot, n)
                put(state, TRACKED, n, (v + at(state, TRACKED, n)) * (1.0 / CYCLE))
            advance_pendula(state, block.pendula, CYCLE, linearised, lanes)
    for n in range(lanes):
        put(state, TRACKED, n, at(scratch, FREE_JOINTS, n))


@inlined
def _send(block: BatchState, s: int, lanes: int) -> None:
    """Send setpoint `s` of the tick, and take the next one that comes into force in each lane."""
    sent, setpoints, delay = block.setpoints, block.controller.setpoints, block.delay
    before, target = block.before, block.target
    block.newest[0] = (block.newest[0] + 1) % SETPOINT_HISTORY
    row = FREE_JOINTS * block.newest[0]
    for i in range(FREE_JOINTS):
        for n in range(lanes):
            put(sent, row + i, n, at(setpoints, FREE_JOINTS * s + i, n))
    least, most = delay[0], delay[0]
    for n in range(lanes):
        least, most = min(least, delay[n]), max(most, delay[n])
    for k in range(FREE_JOINTS * BATCH_SIZE):
        before[k] = target[k]
    # The delays of all lanes span few setpoints: whole rows are read for each of them.
    for age in range(least, most + 1):
        row = FREE_JOINTS * ((block.newest[0] - age) % SETPOINT_HISTORY)
        for i in range(FREE_JOINTS):
            for n in range(lanes):
                old = at(target, i, n)
                put(target, i, n, at(sent, row + i, n) if delay[n] == age else old)


@inlined
def measure(controller: ControllerParams, block: BatchState, lanes: int) -> None:
    """Write encoder counts and measured joints to the controllers of the first lanes."""
    memory, state, frame, zero = block.controller, block.state, block.frame, block.zero
    for n in range(lanes):
        tilt = -pose_error(frame, memory.reference, n)[4]
        theta = pi - (at(state, PHI, n) - tilt + at(zero, 0, n))
        put(memory.counts, 0, n, floor(theta * (1.0 / controller.resolution) + 0.5))
    measured, q = memory.measured, block.q
    for i in range(FREE_JOINTS * BATCH_SIZE):
        measured[i] = q[i]


@inlined
def advance_pendula(state: Array, pendula: Array, h: float, linearised: bool, lanes: int) -> None:
    """Advance the pendulums of the first lanes by one time step, driven by u'."""
    dry = 0.0
    for n in range(lanes):
        dry = max(dry, at(pendula, 3, n))
    # Dry friction can stop the pendulum within a step: those branches have a loop of their own.
    if dry == 0.0:
        for n in range(lanes):
            phi, phi_dot, tracked = at(state, PHI, n), at(state, PHI_DOT, n), at(state, TRACKED, n)
            own = pendulum_of(pendula, linearised, n)
            phi, phi_dot = runge_kutta(phi, phi_dot, tracked, h, 0.0, own)
            put(state, PHI, n, phi)
            put(state, PHI_DOT, n, phi_dot)
    else:
        for n in range(lanes):
            phi, phi_dot, tracked = at(state, PHI, n), at(state, PHI_DOT, n), at(state, TRACKED, n)
            own = pendulum_of(pendula, linearised, n)
            phi, phi_dot = pendulum_step(phi, phi_dot, tracked, h, own)
            put(state, PHI, n, phi)
            put(state, PHI_DOT, n, phi_dot)


@inlined
def pendulum_of(pendula: Array, linearised: bool, n: int) -> PendulumParameters:
    """Return the pendulum of lane `n`."""
    return PendulumParameters(
        at(pendula, 0, n),
        at(pendula, 1, n),
        at(pendula, 2, n),
        at(pendula, 3, n),
        at(pendula, 4, n),
        linearised,
    )


@inlined
def draw_noise(
    noise: Array,
    seed: int,
    tick: IntArray,
    index: IntArray,
    learner: int,
    stream: int,
    lanes: int,
) -> None:
    """Write six standard normal numbers for each lane, from `stream` and the one after it.

    Args:
        noise: A block of 6 rows.
        seed: Master seed.
        tick: Step of each lane within its episode or trial.
        index: Episode or trial of each lane.
        learner: Number of the learner.
        stream: First of the two streams of random numbers.
        lanes: Number of lanes.
    """
    for n in range(lanes):
        w0, w1, w2, w3 = philox(seed, tick[n], index[n], learner, stream)
        v0, v1, _, _ = philox(seed, tick[n], index[n], learner, stream + 1)
        put(noise, 0, n, uniform(w0, 1.0, 0.0))
        put(noise, 1, n, turn(w1))
        put(noise, 2, n, uniform(w2, 1.0, 0.0))
        put(noise, 3, n, turn(w3))
        put(noise, 4, n, uniform(v0, 1.0, 0.0))
        put(noise, 5, n, turn(v1))
    # Loops with few arrays and formulas: a compiler vectorises no large one.
    for i in range(0, 6, 2):
        for n in range(lanes):
            radius = normal_radius(at(noise, i, n))
            sine, cosine = sincos(at(noise, i + 1, n))
            put(noise, i, n, radius * cosine)
            put(noise, i + 1, n, radius * sine)


@inlined
def box_of(seen: Array, boxes: Grid, n: int) -> int:
    """Return the box of the observation of lane `n`."""
    return box_index(
        at(seen, OBS_X, n),
        at(seen, OBS_X_DOT, n),
        at(seen, OBS_PHI, n),
        at(seen, OBS_PHI_DOT, n),
        boxes,
    )


@called
def copy_lane(block: BatchState, source: int, target: int) -> None:
    """Copy the state of one lane to another, to fill the gap of a finished lane."""
    copy_controller_state(block.controller, source, target)
    copy_rows(block.pendula, source, target)
    copy_rows(block.state, source, target)
    copy_rows(block.q, source, target)
    copy_rows(block.dq, source, target)
    copy_rows(block.frame, source, target)
    copy_rows(block.share, source, target)
    copy_rows(block.setpoints, source, target)
    copy_rows(block.target, source, target)
    copy_rows(block.delay, source, target)
    copy_rows(block.turn, source, target)
    copy_rows(block.zero, source, target)
    block.cause[target] = block.cause[source]


@called
def scaled(
    pendulum: PendulumParameters, inertia_factor: float, friction_factor: float
) -> PendulumParameters:
    """Return the pendulum with I and b multiplied: I divides everything, b scales c alone.

    Factors come from normal distributions: I keeps at least a tenth of itself, b is not negative.
    """
    inertia_factor = max(inertia_factor, MIN_INERTIA_FACTOR)
    friction_factor = max(friction_factor, 0.0)
    return PendulumParameters(
        pendulum.w2 / inertia_factor,
        pendulum.k / inertia_factor,
        pendulum.c * friction_factor / inertia_factor,
        pendulum.coulomb / inertia_factor,
        pendulum.drag / inertia_factor,
        pendulum.linearised,
    )
