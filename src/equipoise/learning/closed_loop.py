"""The closed loop: one control step of arm and pendulum.

A step of h = 0.01 s goes: u -> CLIK -> joint motion -> tracked acceleration u' -> pendulum. The
reference moves along base x only; u' = n^T Gamma' is the change of the flange's velocity along x
over the step, divided by h, and drives the pendulum (section 3.2). Noise is the paper's: on I and b
once per episode, on the pose error e in every step.

Kernels advance a block of independent states at once, one to a lane (`equipoise.model.elementary`).
Training, evaluation, the recorded run and any policy written in Python call the `step` below; what
happens in a lane does not depend on the others.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import inlined, kernel
from equipoise.control.boxes import Boxes, box_index, boxes
from equipoise.control.clik import (
    GAMMA,
    REFERENCE_SIZE,
    ClikParameters,
    joint_acceleration,
    manipulability,
    pose_error,
    solve,
)
from equipoise.errors import ArmError
from equipoise.model.arms.arm import FRAME_SIZE, POSITION, TWIST, Arm, KinematicsFunction
from equipoise.model.elementary import LANES, at, put, sincos
from equipoise.model.pendulum import PendulumParameters, runge_kutta
from equipoise.model.pendulum import step as pendulum_step
from equipoise.model.random import normal_radius, philox, turn, uniform
from equipoise.settings import Settings

Array = npt.NDArray[np.float64]

LASTED: Final = 0
ANGLE: Final = 1
TRACK: Final = 2
JOINT_LIMIT: Final = 3
CAUSES: Final = ("lasted", "angle", "track", "joint limit")
"""How a trial ends, by code."""

LEAST_MANIPULABILITY: Final = 1e-6
"""Below this |det J| [m^3] a home posture counts as singular; an iiwa at home has 0.09."""
LEAST_INERTIA_FACTOR: Final = 0.1
POSE_ITERATIONS: Final = 20
POSE_TOLERANCE: Final = 1e-12

# Rows of the block of states.
X: Final = 0
X_DOT: Final = 1
PHI: Final = 2
PHI_DOT: Final = 3
TRACKED: Final = 4
STATE_SIZE: Final = 5
PARAMETERS: Final = 5
"""Rows of the block of pendulums: the numbers of `PendulumParameters`."""


class Plant(NamedTuple):
    """What does not change during an episode."""

    kinematics: KinematicsFunction
    """The arm's kinematics."""
    clik: ClikParameters
    """Gains and damping."""
    limits: Array
    """Lower, upper, velocity and acceleration limits of the free joints, shape (4, 6)."""
    home: Array
    """Free joints at x = 0 [rad], shape (6,)."""
    home_reference: Array
    """Pose of the flange at home, at rest, as a reference, shape (24,)."""
    h: float
    """Time step [s]."""
    phi_limit: float
    """|phi| of failure [rad]."""
    x_limit: float
    """|x| of failure [m]."""
    position_noise: float
    """Standard deviation of the noise on the position part of e [m]."""
    orientation_noise: float
    """Standard deviation of the noise on the orientation part of e [rad]."""
    linearised: bool
    """Whether the pendulum is that of equation (7)."""


class Block(NamedTuple):
    """The states of `LANES` closed loops, which a step changes in place; each a block of rows."""

    q: Array
    """Free joints [rad], 6 rows."""
    dq: Array
    """Their velocities [rad/s], 6 rows."""
    ddq: Array
    """Their accelerations over the last step [rad/s^2], 6 rows."""
    frame: Array
    """Record of the kinematics at q, dq."""
    reference: Array
    """Record of where the flange shall be."""
    e: Array
    """Room for the pose error, 6 rows."""
    noise: Array
    """Standard normal numbers for the next step, 6 rows."""
    pendula: Array
    """Numbers of `PendulumParameters`, 5 rows."""
    state: Array
    """x, x_dot, phi, phi_dot, and u' of the last step, in SI units, 5 rows."""
    u: Array
    """Commanded acceleration of the next step [m/s^2], 1 row."""
    cause: npt.NDArray[np.int64]
    """Cause of failure in the last step, 1 row."""
    damped: npt.NDArray[np.int64]
    """How often the inverse was damped near a singularity, in all lanes, shape (1,)."""


def make_plant(arm: Arm, settings: Settings, h: float) -> Plant:
    """Return the constants of a plant for compiled loops.

    Args:
        arm: The arm with its home posture.
        settings: Gains and noise.
        h: Time step [s].

    Raises:
        ArmError: Home is a singular posture.
    """
    kernel_arm = arm.compiled()
    q, frame = np.zeros(6 * LANES), np.zeros(FRAME_SIZE * LANES)
    q[::LANES] = arm.home_free
    kernel_arm.kinematics(q, np.zeros(6 * LANES), frame, 1)
    w = float(manipulability(frame, 0))
    if w < LEAST_MANIPULABILITY:
        raise ArmError(
            f"the home posture of {arm.name} is singular (|det J| = {w:.1e} m^3); choose another"
        )
    limits = boxes()
    wrist_x, wrist_y, wrist_z = (float(value) for value in kernel_arm.wrist)
    return Plant(
        kinematics=kernel_arm.kinematics,
        clik=ClikParameters(
            K_p=settings.clik.K_p,
            K_d=settings.clik.K_d,
            w_0=settings.clik.singular_share * w,
            lambda_0=settings.clik.damping,
            wrist=(wrist_x, wrist_y, wrist_z),
        ),
        limits=np.array(
            [
                kernel_arm.lower,
                kernel_arm.upper,
                kernel_arm.max_velocity,
                kernel_arm.max_acceleration,
            ]
        ),
        home=arm.home_free,
        home_reference=frame[: REFERENCE_SIZE * LANES : LANES].copy(),
        h=h,
        phi_limit=limits.phi_limit,
        x_limit=limits.x_limit,
        position_noise=settings.plant.position_error_sigma,
        orientation_noise=settings.plant.orientation_error_sigma,
        linearised=settings.plant.linearised,
    )


def new_block() -> Block:
    """Return a block for `reset`."""
    rows = (6, 6, 6, FRAME_SIZE, REFERENCE_SIZE, 6, 6, PARAMETERS, STATE_SIZE, 1)
    return Block(
        *(np.zeros(count * LANES) for count in rows),
        cause=np.zeros(LANES, np.int64),
        damped=np.zeros(1, np.int64),
    )


@kernel
def reset(
    plant: Plant,
    block: Block,
    pendulum: PendulumParameters,
    start: tuple[float, float, float, float],
    n: int,
) -> None:
    """Place lane `n` at a state: the arm on its track without error, the pendulum as given.

    Args:
        plant: Constants.
        block: Changed in place.
        pendulum: Physical parameters of this lane until its next reset.
        start: Displacement of the flange from home along base x [m], its velocity [m/s], angle of
            the pendulum from upright [rad] and its angular velocity [rad/s].
        n: Lane.
    """
    x, x_dot, phi, phi_dot = start
    # The arm is placed in the first lane of blocks of its own, by Newton's method.
    q, dq, dy = np.zeros(6 * LANES), np.zeros(6 * LANES), np.zeros(6 * LANES)
    e, frame = np.zeros(6 * LANES), np.zeros(FRAME_SIZE * LANES)
    reference = np.zeros(REFERENCE_SIZE * LANES)
    for i in range(REFERENCE_SIZE):
        put(reference, i, 0, plant.home_reference[i])
        put(block.reference, i, n, plant.home_reference[i])
    for i in range(6):
        put(q, i, 0, plant.home[i])
    put(reference, POSITION, 0, plant.home_reference[POSITION] + x)
    for _ in range(POSE_ITERATIONS):
        plant.kinematics(q, dq, frame, 1)
        error = pose_error(frame, reference, 0)
        largest = 0.0
        for i in range(6):
            put(e, i, 0, error[i])
            largest = max(largest, abs(error[i]))
        if largest < POSE_TOLERANCE:
            break
        solve(frame, e, plant.clik, dy, 1)
        q += dy
    e[:] = 0.0
    put(e, 0, 0, x_dot)
    solve(frame, e, plant.clik, dq, 1)
    plant.kinematics(q, dq, frame, 1)
    for i in range(6):
        put(block.q, i, n, at(q, i, 0))
        put(block.dq, i, n, at(dq, i, 0))
        put(block.ddq, i, n, 0.0)
    for i in range(FRAME_SIZE):
        put(block.frame, i, n, at(frame, i, 0))
    put(block.reference, POSITION, n, at(reference, POSITION, 0))
    put(block.reference, TWIST, n, x_dot)
    put(block.pendula, 0, n, pendulum.w2)
    put(block.pendula, 1, n, pendulum.k)
    put(block.pendula, 2, n, pendulum.c)
    put(block.pendula, 3, n, pendulum.coulomb)
    put(block.pendula, 4, n, pendulum.drag)
    put(block.state, X, n, at(frame, POSITION, 0) - plant.home_reference[POSITION])
    put(block.state, X_DOT, n, at(frame, TWIST, 0))
    put(block.state, PHI, n, phi)
    put(block.state, PHI_DOT, n, phi_dot)
    put(block.state, TRACKED, n, 0.0)
    block.cause[n] = LASTED


@kernel
def step(plant: Plant, block: Block, lanes: int) -> None:
    """Advance arm and pendulum of the first lanes by one time step.

    Reads `block.u` and `block.noise`; everything else of the block is brought up to date, with the
    cause of failure of each lane, `LASTED` if none.

    Args:
        plant: Constants.
        block: Changed in place.
        lanes: How many lanes.
    """
    q, dq, ddq, frame, reference, e, noise, pendula, state, u, cause, damped = block
    h, limits, home_x = plant.h, plant.limits, plant.home_reference[POSITION]
    sigma_p, sigma_o = plant.position_noise, plant.orientation_noise
    for n in range(lanes):
        e0, e1, e2, e3, e4, e5 = pose_error(frame, reference, n)
        put(e, 0, n, e0 + sigma_p * at(noise, 0, n))
        put(e, 1, n, e1 + sigma_p * at(noise, 1, n))
        put(e, 2, n, e2 + sigma_p * at(noise, 2, n))
        put(e, 3, n, e3 + sigma_o * at(noise, 3, n))
        put(e, 4, n, e4 + sigma_o * at(noise, 4, n))
        put(e, 5, n, e5 + sigma_o * at(noise, 5, n))
        put(reference, GAMMA, n, u[n])
    damped[0] += joint_acceleration(frame, reference, e, plant.clik, ddq, lanes)
    for n in range(lanes):
        cause[n] = LASTED
        # u' starts as minus the velocity before the step.
        put(state, TRACKED, n, -at(frame, TWIST, n))
        move = at(reference, TWIST, n) * h + 0.5 * u[n] * h * h
        put(reference, POSITION, n, at(reference, POSITION, n) + move)
        put(reference, TWIST, n, at(reference, TWIST, n) + u[n] * h)
    for i in range(6):
        lower, upper = limits[0, i], limits[1, i]
        max_velocity, max_acceleration = limits[2, i], limits[3, i]
        for n in range(lanes):
            a, v = at(ddq, i, n), at(dq, i, n)
            angle = at(q, i, n) + v * h + 0.5 * a * h * h
            v += a * h
            put(q, i, n, angle)
            put(dq, i, n, v)
            within = (
                (lower <= angle)
                & (angle <= upper)
                & (abs(v) <= max_velocity)
                & (abs(a) <= max_acceleration)
            )
            cause[n] = cause[n] if within else JOINT_LIMIT
    plant.kinematics(q, dq, frame, lanes)
    for n in range(lanes):
        tracked = (at(frame, TWIST, n) + at(state, TRACKED, n)) / h
        put(state, TRACKED, n, tracked)
        put(state, X, n, at(frame, POSITION, n) - home_x)
        put(state, X_DOT, n, at(frame, TWIST, n))
    advance_pendula(state, pendula, h, plant.linearised, lanes)
    for n in range(lanes):
        on_track = abs(at(state, X, n)) < plant.x_limit
        upright = abs(at(state, PHI, n)) < plant.phi_limit
        cause[n] = (cause[n] if on_track else TRACK) if upright else ANGLE


@kernel
def advance_pendula(state: Array, pendula: Array, h: float, linearised: bool, lanes: int) -> None:
    """Advance the pendulums of the first lanes by one time step, driven by u'."""
    dry = 0.0
    for n in range(lanes):
        dry = max(dry, at(pendula, 3, n))
    # Dry friction can stop the pendulum within a step, which takes branches: a loop of its own.
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


@kernel
def draw_noise(
    noise: Array,
    seed: int,
    tick: npt.NDArray[np.int64],
    index: npt.NDArray[np.int64],
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
        learner: Which learner.
        stream: Purpose of the numbers.
        lanes: How many lanes.
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
    # The logarithm is a call, and has a loop of its own so that the others run in lanes.
    for i in range(0, 6, 2):
        for n in range(lanes):
            put(noise, i, n, normal_radius(at(noise, i, n)))
    for i in range(0, 6, 2):
        for n in range(lanes):
            radius = at(noise, i, n)
            sine, cosine = sincos(at(noise, i + 1, n))
            put(noise, i, n, radius * cosine)
            put(noise, i + 1, n, radius * sine)


@inlined
def box_of(state: Array, boxes: Boxes, n: int) -> int:
    """Return the box of lane `n`."""
    return box_index(
        at(state, X, n), at(state, X_DOT, n), at(state, PHI, n), at(state, PHI_DOT, n), boxes
    )


@kernel
def copy_lane(block: Block, source: int, target: int) -> None:
    """Copy the state of one lane to another, which closes the gap that a finished one leaves."""
    for i in range(6):
        put(block.q, i, target, at(block.q, i, source))
        put(block.dq, i, target, at(block.dq, i, source))
        put(block.ddq, i, target, at(block.ddq, i, source))
    for i in range(FRAME_SIZE):
        put(block.frame, i, target, at(block.frame, i, source))
    for i in range(REFERENCE_SIZE):
        put(block.reference, i, target, at(block.reference, i, source))
    for i in range(PARAMETERS):
        put(block.pendula, i, target, at(block.pendula, i, source))
    for i in range(STATE_SIZE):
        put(block.state, i, target, at(block.state, i, source))
    block.cause[target] = block.cause[source]


@kernel
def scaled(
    pendulum: PendulumParameters, inertia_factor: float, friction_factor: float
) -> PendulumParameters:
    """Return the pendulum with I and b multiplied: I divides everything, b scales c alone.

    Factors come from normal distributions: I keeps at least a tenth of itself, b is not negative.
    """
    inertia_factor = max(inertia_factor, LEAST_INERTIA_FACTOR)
    friction_factor = max(friction_factor, 0.0)
    return PendulumParameters(
        pendulum.w2 / inertia_factor,
        pendulum.k / inertia_factor,
        pendulum.c * friction_factor / inertia_factor,
        pendulum.coulomb / inertia_factor,
        pendulum.drag / inertia_factor,
        pendulum.linearised,
    )
