"""The closed loop: one control step of arm and pendulum, and trials of many steps.

A step of h = 0.01 s goes: u -> CLIK -> joint motion -> tracked acceleration u' -> pendulum. The
reference moves along base x only; u' = n^T Gamma' is the change of the flange's velocity along x
over the step, divided by h, and drives the pendulum (section 3.2). Noise is the paper's: on I and b
once per episode, on the pose error e in every step.

Training, evaluation, the recorded run and any policy written in Python call the `step` below. A
trial ends with the cause of its failure, or lasts.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.control.boxes import boxes
from equipoise.control.clik import (
    GAMMA,
    REFERENCE_SIZE,
    ClikParameters,
    Point,
    Twist,
    joint_acceleration,
    manipulability,
    pose_error,
    solve,
)
from equipoise.control.policy import RANDOM, PolicyKernel, act
from equipoise.errors import ArmError
from equipoise.model import pendulum as pendulum_model
from equipoise.model.arms.arm import FRAME_SIZE, POSITION, TWIST, Arm, KinematicsFunction
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import normal_pair, philox, uniform
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
POSE_ITERATIONS: Final = 20
POSE_TOLERANCE: Final = 1e-12


class Plant(NamedTuple):
    """What does not change during an episode.

    Flat, with few arrays: taking an array out of a tuple costs a kernel about as much as a sine.
    """

    kinematics: KinematicsFunction
    """The arm's kinematics."""
    wrist: Point
    """Where the last three axes meet, in the flange frame [m]; NaN if they do not."""
    limits: Array
    """Lower, upper, velocity and acceleration limits of the free joints, shape (4, 6)."""
    clik: ClikParameters
    """Gains and damping."""
    home: Array
    """Free joints at x = 0 [rad], shape (6,)."""
    home_reference: Array
    """Record of the flange at home, at rest."""
    home_x: float
    """Where x = 0 is in the base [m]."""
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


class Memory(NamedTuple):
    """What a step changes, in place."""

    q: Array
    """Free joints [rad], shape (6,)."""
    dq: Array
    """Their velocities [rad/s], shape (6,)."""
    ddq: Array
    """Their accelerations over the last step [rad/s^2], shape (6,)."""
    frame: Array
    """Record of the kinematics at q, dq."""
    reference: Array
    """Record of where the flange shall be."""
    state: Array
    """x, x_dot, phi, phi_dot in SI units, shape (4,)."""


class Outcome(NamedTuple):
    """What a step came to."""

    cause: int
    """Cause of failure, `LASTED` if none."""
    tracked: float
    """u', what the flange's acceleration along x really was [m/s^2]."""
    damped: bool
    """Whether the arm was near a singularity, where the inverse is damped."""


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
    frame = np.zeros(FRAME_SIZE)
    kernel_arm.kinematics(arm.home_free, np.zeros(6), frame)
    w = float(manipulability(frame))
    if w < LEAST_MANIPULABILITY:
        raise ArmError(
            f"the home posture of {arm.name} is singular (|det J| = {w:.1e} m^3); choose another"
        )
    limits = boxes()
    wrist_x, wrist_y, wrist_z = (float(value) for value in kernel_arm.wrist)
    return Plant(
        kinematics=kernel_arm.kinematics,
        wrist=(wrist_x, wrist_y, wrist_z),
        limits=np.array(
            [
                kernel_arm.lower,
                kernel_arm.upper,
                kernel_arm.max_velocity,
                kernel_arm.max_acceleration,
            ]
        ),
        clik=ClikParameters(
            K_p=settings.clik.K_p,
            K_d=settings.clik.K_d,
            w_0=settings.clik.singular_share * w,
            lambda_0=settings.clik.damping,
        ),
        home=arm.home_free,
        home_reference=frame[:REFERENCE_SIZE].copy(),
        home_x=float(frame[POSITION]),
        h=h,
        phi_limit=limits.phi_limit,
        x_limit=limits.x_limit,
        position_noise=settings.plant.position_error_sigma,
        orientation_noise=settings.plant.orientation_error_sigma,
    )


@kernel
def new_memory() -> Memory:
    """Return a memory for `reset`."""
    return Memory(
        q=np.zeros(6),
        dq=np.zeros(6),
        ddq=np.zeros(6),
        frame=np.zeros(FRAME_SIZE),
        reference=np.zeros(REFERENCE_SIZE),
        state=np.zeros(4),
    )


@kernel
def reset(
    plant: Plant, memory: Memory, x: float, x_dot: float, phi: float, phi_dot: float
) -> None:
    """Place arm, reference and pendulum at a state, the arm on its track without error.

    Args:
        plant: Constants.
        memory: Changed in place.
        x: Displacement of the flange from home along base x [m].
        x_dot: Its velocity [m/s].
        phi: Angle of the pendulum from upright [rad].
        phi_dot: Its angular velocity [rad/s].
    """
    q, dq, ddq, frame, reference, state = memory
    q[:] = plant.home
    dq[:] = 0.0
    reference[:] = plant.home_reference
    reference[POSITION] += x
    for _ in range(POSE_ITERATIONS):
        plant.kinematics(q, dq, frame)
        e = pose_error(frame, reference)
        if max(abs(e[0]), abs(e[1]), abs(e[2]), abs(e[3]), abs(e[4]), abs(e[5])) < POSE_TOLERANCE:
            break
        solve(frame, e, plant.clik, plant.wrist, ddq)
        q += ddq
    reference[TWIST] = x_dot
    solve(frame, (x_dot, 0.0, 0.0, 0.0, 0.0, 0.0), plant.clik, plant.wrist, dq)
    ddq[:] = 0.0
    plant.kinematics(q, dq, frame)
    state[0] = frame[POSITION] - plant.home_x
    state[1] = frame[TWIST]
    state[2] = phi
    state[3] = phi_dot


@kernel
def step(
    plant: Plant, memory: Memory, u: float, noise: Twist, pendulum: PendulumParameters
) -> Outcome:
    """Advance arm and pendulum by one time step.

    Args:
        plant: Constants.
        memory: Changed in place.
        u: Commanded acceleration of the flange along x [m/s^2].
        noise: Six standard normal numbers, scaled here and added to e.
        pendulum: Physical parameters of this episode.

    Returns:
        What the step came to.
    """
    q, dq, ddq, frame, reference, state = memory
    h, limits = plant.h, plant.limits
    reference[GAMMA] = u
    e = pose_error(frame, reference)
    sigma_p, sigma_o = plant.position_noise, plant.orientation_noise
    e = (
        e[0] + sigma_p * noise[0],
        e[1] + sigma_p * noise[1],
        e[2] + sigma_p * noise[2],
        e[3] + sigma_o * noise[3],
        e[4] + sigma_o * noise[4],
        e[5] + sigma_o * noise[5],
    )
    damped = joint_acceleration(frame, reference, e, plant.clik, plant.wrist, ddq)
    within = True
    for i in range(6):
        q[i] += dq[i] * h + 0.5 * ddq[i] * h * h
        dq[i] += ddq[i] * h
        within &= (
            (limits[0, i] <= q[i])
            & (q[i] <= limits[1, i])
            & (abs(dq[i]) <= limits[2, i])
            & (abs(ddq[i]) <= limits[3, i])
        )
    reference[POSITION] += reference[TWIST] * h + 0.5 * u * h * h
    reference[TWIST] += u * h

    x_dot_before = frame[TWIST]
    plant.kinematics(q, dq, frame)
    tracked = (frame[TWIST] - x_dot_before) / h
    phi, phi_dot = pendulum_model.step(state[2], state[3], tracked, h, pendulum)
    x = frame[POSITION] - plant.home_x
    state[0] = x
    state[1] = frame[TWIST]
    state[2] = phi
    state[3] = phi_dot
    cause = LASTED
    if abs(phi) >= plant.phi_limit:
        cause = ANGLE
    elif abs(x) >= plant.x_limit:
        cause = TRACK
    elif not within:
        cause = JOINT_LIMIT
    return Outcome(cause, tracked, damped)


@kernel
def draw_noise(seed: int, tick: int, index: int, learner: int, stream: int) -> Twist:
    """Return six standard normal numbers from `stream` and the one after it."""
    w0, w1, w2, w3 = philox(seed, tick, index, learner, stream)
    n0, n1 = normal_pair(w0, w1)
    n2, n3 = normal_pair(w2, w3)
    w0, w1, w2, w3 = philox(seed, tick, index, learner, stream + 1)
    n4, n5 = normal_pair(w0, w1)
    return n0, n1, n2, n3, n4, n5


@kernel
def scaled(
    pendulum: PendulumParameters, inertia_factor: float, friction_factor: float
) -> PendulumParameters:
    """Return the pendulum with I and b multiplied: I divides everything, b scales c alone."""
    return PendulumParameters(
        pendulum.w2 / inertia_factor,
        pendulum.k / inertia_factor,
        pendulum.c * friction_factor / inertia_factor,
        pendulum.coulomb / inertia_factor,
        pendulum.drag / inertia_factor,
        pendulum.linearised,
    )


class Trials(NamedTuple):
    """Conditions of n trials, one row each, and what came of them."""

    start: Array
    """x, x_dot, phi, phi_dot, shape (n, 4)."""
    inertia_factor: Array
    """Factor on I, shape (n,)."""
    friction_factor: Array
    """Factor on b, shape (n,)."""
    steps: npt.NDArray[np.int64]
    """How many steps each lasted, shape (n,)."""
    cause: npt.NDArray[np.int64]
    """How each ended, shape (n,)."""
    sum_x2: Array
    """Sum of x^2 over its steps [m^2], shape (n,)."""


@kernel
def run_trials(
    plant: Plant,
    policy: PolicyKernel,
    pendulum: PendulumParameters,
    trials: Trials,
    first: int,
    last: int,
    longest: int,
    seed: int,
    stream: int,
) -> None:
    """Run the trials first <= i < last and write what came of them.

    Args:
        plant: Constants.
        policy: What decides.
        pendulum: The centre that the factors of each trial scale.
        trials: Conditions, and arrays that are written.
        first: First trial.
        last: One past the last trial.
        longest: Number of steps after which a trial has lasted.
        seed: Seed of the noise.
        stream: Stream of the noise: selection or test.
    """
    memory = new_memory()
    state = memory.state
    for i in range(first, last):
        x, x_dot, phi, phi_dot = trials.start[i]
        reset(plant, memory, x, x_dot, phi, phi_dot)
        own = scaled(pendulum, trials.inertia_factor[i], trials.friction_factor[i])
        cause = LASTED
        sum_x2 = 0.0
        tick = 0
        while tick < longest and cause == LASTED:
            noise = draw_noise(seed, tick, i, 0, stream)
            chance = 0.0
            if policy.kind == RANDOM:
                chance = uniform(philox(seed, tick, i, 1, stream)[0], 0.0, 1.0)
            u = act(policy, state[0], state[1], state[2], state[3], chance)
            cause = step(plant, memory, u, noise, own).cause
            sum_x2 += state[0] * state[0]
            tick += 1
        trials.steps[i] = tick
        trials.cause[i] = cause
        trials.sum_x2[i] = sum_x2


class Recording(NamedTuple):
    """What one recorded run went through, a row per step."""

    state: Array
    """x, x_dot, phi, phi_dot before the step, shape (n, 4)."""
    u: Array
    """Commanded acceleration [m/s^2], shape (n,)."""
    tracked: Array
    """Tracked acceleration u' [m/s^2], shape (n,)."""
    q: Array
    """Free joints at the end of the step [rad], shape (n, 6)."""
    dq: Array
    """Their velocities [rad/s], shape (n, 6)."""


def record_trial(
    plant: Plant,
    policy: Any,
    pendulum: PendulumParameters,
    start: Array,
    longest: int,
    seed: int,
    stream: int,
    index: int = 0,
) -> tuple[int, Recording]:
    """Run one trial with a policy written in Python, `policy.act(state) -> u`, and record it.

    It is the loop of `run_trials`, step for step and noise for noise.

    Args:
        plant: Constants.
        policy: Any object that meets `Policy`.
        pendulum: Physical parameters of the trial.
        start: x, x_dot, phi, phi_dot.
        longest: Number of steps after which the trial has lasted.
        seed: Seed of the noise.
        stream: Stream of the noise.
        index: Number of the trial.

    Returns:
        Cause of the end, and the recording.
    """
    memory = new_memory()
    reset(plant, memory, *(float(value) for value in start))
    rows = Recording(
        *(np.zeros((longest, width)) if width else np.zeros(longest) for width in (4, 0, 0, 6, 6))
    )
    cause, tick = LASTED, 0
    while tick < longest and cause == LASTED:
        noise = draw_noise(seed, tick, index, 0, stream)
        rows.state[tick] = memory.state
        u = float(policy.act(memory.state.copy()))
        cause, rows.tracked[tick], _ = step(plant, memory, u, noise, pendulum)
        rows.u[tick] = u
        rows.q[tick] = memory.q
        rows.dq[tick] = memory.dq
        tick += 1
    return int(cause), Recording(*(row[:tick] for row in rows))
