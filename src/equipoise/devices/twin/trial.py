"""Trials of a policy on the twin: controller, cabinet, arm, pendulum and sensors in one kernel.

The control step is the one of training and deployment: what the sensors show becomes what the
policy sees, its u becomes two setpoints. The truth decides how a trial ends, not what the sensors
show; but where a world has guards, these decide too, by what a rig would know. A trial depends on
its conditions, the master seed and its number, and on nothing else: not on the number of workers,
nor on the trials before it.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import pi
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.control.boxes import ANGLE, JOINT_LIMIT, SAFETY_STOP, TRACK, TRUNCATED, Boxes, boxes
from equipoise.control.control_step import (
    OBS_PHI,
    OBS_PHI_DOT,
    OBS_X,
    OBS_X_DOT,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    command,
    new_controller_state,
    observe,
    start_controller,
)
from equipoise.control.policy import RANDOM, PolicyKernel, act
from equipoise.control.safety import NO_VIOLATION, SafetyParams
from equipoise.control.trial_safety import (
    TrialSafetyMonitor,
    new_trial_monitor,
    refused,
    reset_trial_monitor,
    stopped,
)
from equipoise.devices.twin.physics import TICK
from equipoise.devices.twin.sensors import encoder, reply
from equipoise.devices.twin.servo_model import NOW, make_servo_params
from equipoise.devices.twin.twin import Twin, TwinKernel, advance, reset, send_free, truth
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.elementary import at, put
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import TWIN, philox, uniform
from equipoise.model.sim_configs import TwinSettings

Array = npt.NDArray[np.float64]


class Trial(NamedTuple):
    """Conditions of one trial: the arm waits at home, the pendulum is let go."""

    number: int
    """With the seed it decides noise, jitter and the encoder's zero."""
    pendulum: PendulumParameters
    """The pendulum of this trial, with the friction that acts in the twin."""
    phi: float
    """Angle of the pendulum from upright at the release [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""


class TrialResult(NamedTuple):
    """What came of a trial."""

    steps: int
    """How many control steps it lasted."""
    cause: int
    """How it ended: LASTED, ANGLE, TRACK, JOINT_LIMIT, or from GUARD on which guard ended it."""
    sum_x2: float
    """Sum of x^2 over its steps [m^2]."""


class TrialRecord(NamedTuple):
    """What a trial goes through, a row for each tick; room for none records nothing."""

    observation: Array
    """x, x_dot, phi, phi_dot as the policy saw them, shape (n, 4)."""
    u: Array
    """Commanded acceleration [m/s^2], shape (n,)."""
    estimate: Array
    """Estimated phi [rad], phi_dot [rad/s], bias of phi [rad] and pivot velocity [m/s] at the
    tick, shape (n, 4)."""
    counts: Array
    """Encoder counts, and their time stamp [s], shape (n, 2)."""
    measured: Array
    """Measured free joints [rad], and when they were measured [s], shape (n, 7)."""
    setpoints: Array
    """Free joints sent at the tick and half a step later [rad], shape (n, 12)."""
    command: Array
    """Commanded free joints [rad] and their velocities [rad/s] at the end of the step,
    shape (n, 12)."""
    truth: Array
    """x, x_dot, phi, phi_dot as they were at the tick, shape (n, 4)."""
    q: Array
    """All joints as they were at the tick [rad], shape (n, joints)."""


def new_trial_record(length: int, joints: int) -> TrialRecord:
    """Return room for the rows of a trial of so many steps, on an arm of so many joints."""
    return TrialRecord(
        observation=np.zeros((length, 4)),
        u=np.zeros(length),
        estimate=np.zeros((length, 4)),
        counts=np.zeros((length, 2)),
        measured=np.zeros((length, FREE_JOINTS + 1)),
        setpoints=np.zeros((length, SETPOINTS_PER_TICK * FREE_JOINTS)),
        command=np.zeros((length, 2 * FREE_JOINTS)),
        truth=np.zeros((length, 4)),
        q=np.zeros((length, joints)),
    )


@kernel
def release(
    twin: TwinKernel,
    controller: ControllerParams,
    memory: ControllerState,
    phi: float,
    phi_dot: float,
) -> None:
    """Let the pendulum go, the arm waiting at home; the controller has seen it until now.

    Args:
        twin: Changed in place.
        controller: Constants.
        memory: Changed in place.
        phi: Angle of the pendulum from upright [rad].
        phi_dot: Its rate [rad/s].
    """
    reset(twin, twin.home, phi, phi_dot)
    counts, stamp = encoder(twin.sensors, twin.past, 0, twin.seed, twin.trial)
    shown = pi - counts * controller.resolution - stamp * phi_dot
    start_controller(controller, memory, 0.0, 0.0, shown, phi_dot, 0)


@kernel
def step(
    twin: TwinKernel,
    controller: ControllerParams,
    memory: ControllerState,
    limits: Boxes,
    watching: TrialSafetyMonitor,
) -> int:
    """Let a control step pass: send what u asks for, and see what the sensors show at its end.

    Args:
        twin: Changed in place.
        controller: Constants.
        memory: Reads u; changed in place.
        limits: |x| and |phi| of failure.
        watching: What guards remember; changed in place.

    Returns:
        The cause of failure, LASTED if none.
    """
    q = np.empty(FREE_JOINTS)
    command(controller, memory, 1)
    for s in range(SETPOINTS_PER_TICK):
        for i in range(FREE_JOINTS):
            q[i] = at(memory.setpoints, 6 * s + i, 0)
        if watching.active:
            broken = refused(watching, q, twin.cabinet.clock[NOW] * TICK)
            if broken != NO_VIOLATION:
                return SAFETY_STOP + broken
        send_free(twin, q)
        advance(twin, round(controller.h / SETPOINTS_PER_TICK / TICK))
    tick = twin.cabinet.clock[NOW]
    counts, counted = encoder(twin.sensors, twin.past, tick, twin.seed, twin.trial)
    measured = reply(twin.sensors, twin.past, tick, twin.seed, twin.trial, q)
    put(memory.counts, 0, 0, counts)
    for i in range(FREE_JOINTS):
        put(memory.measured, i, 0, q[i])
    observe(controller, memory, tick * TICK - counted, tick * TICK - measured, 1)
    real = truth(twin)
    # Written so that a number that is none is a failure.
    if not abs(real.phi) < limits.phi_limit:
        return ANGLE
    if not abs(real.x) < limits.x_limit:
        return TRACK
    if memory.limit_exceeded[0]:
        return JOINT_LIMIT
    if watching.active:
        broken = stopped(watching, controller, memory, q, measured)
        if broken != NO_VIOLATION:
            return SAFETY_STOP + broken
    return TRUNCATED


@kernel
def decide(twin: TwinKernel, memory: ControllerState, policy: PolicyKernel) -> None:
    """Let the policy turn what it sees into u."""
    chance = 0.0
    if policy.kind == RANDOM:
        words = philox(twin.seed, twin.cabinet.clock[NOW], twin.trial, 0, TWIN)
        chance = uniform(words[2], 0.0, 1.0)
    seen = memory.observation
    memory.u[0] = act(
        policy,
        at(seen, OBS_X, 0),
        at(seen, OBS_X_DOT, 0),
        at(seen, OBS_PHI, 0),
        at(seen, OBS_PHI_DOT, 0),
        chance,
    )


@kernel
def run_trial(
    twin: TwinKernel,
    controller: ControllerParams,
    memory: ControllerState,
    policy: PolicyKernel,
    phi: float,
    phi_dot: float,
    max_steps: int,
    limits: Boxes,
    watching: TrialSafetyMonitor,
    rows: TrialRecord,
) -> TrialResult:
    """Run one trial.

    Args:
        twin: Changed in place.
        controller: Constants.
        memory: Room for the controller's state.
        policy: What decides.
        phi: Angle of the pendulum from upright at the release [rad].
        phi_dot: Its rate [rad/s].
        max_steps: Number of steps after which a trial has lasted.
        limits: |x| and |phi| of failure.
        watching: Guards, and room for what they remember.
        rows: Receives a row per step, as far as there is room.
    """
    release(twin, controller, memory, phi, phi_dot)
    reset_trial_monitor(watching, controller.home)
    steps, cause, sum_x2 = 0, TRUNCATED, 0.0
    while steps < max_steps and cause == TRUNCATED:
        decide(twin, memory, policy)
        recorded = steps < len(rows.u)
        if recorded:
            record_before(twin, memory, rows, steps)
        cause = step(twin, controller, memory, limits, watching)
        if recorded:
            record_after(twin, memory, rows, steps)
        steps += 1
        sum_x2 += truth(twin).x ** 2
    return TrialResult(steps, cause, sum_x2)


@kernel
def record_before(twin: TwinKernel, memory: ControllerState, rows: TrialRecord, row: int) -> None:
    """Write what is known at the tick."""
    real = truth(twin)
    tick = twin.cabinet.clock[NOW]
    counts = encoder(twin.sensors, twin.past, tick, twin.seed, twin.trial)
    measured = rows.measured[row]
    rows.measured[row, FREE_JOINTS] = reply(
        twin.sensors, twin.past, tick, twin.seed, twin.trial, measured
    )
    rows.u[row] = memory.u[0]
    for i in range(4):
        rows.observation[row, i] = at(memory.observation, i, 0)
        rows.estimate[row, i] = at(memory.estimate, i, 0)
    rows.truth[row, 0], rows.truth[row, 1] = real.x, real.x_dot
    rows.truth[row, 2], rows.truth[row, 3] = real.phi, real.phi_dot
    rows.counts[row, 0], rows.counts[row, 1] = counts
    for i in range(len(twin.home)):
        rows.q[row, i] = twin.bodies.qpos[i]


@kernel
def record_after(twin: TwinKernel, memory: ControllerState, rows: TrialRecord, row: int) -> None:
    """Write what was commanded in the step."""
    for i in range(FREE_JOINTS * SETPOINTS_PER_TICK):
        rows.setpoints[row, i] = at(memory.setpoints, i, 0)
    for i in range(FREE_JOINTS):
        rows.command[row, i] = at(memory.q, i, 0)
        rows.command[row, FREE_JOINTS + i] = at(memory.dq, i, 0)


def run_over_cores(
    arm: Arm,
    settings: TwinSettings,
    controller: ControllerParams,
    policy: PolicyKernel,
    trials: Sequence[Trial],
    *,
    duration: float,
    seed: int,
    workers: int,
    guard: SafetyParams | None = None,
    done: Callable[[Trial, TrialResult], None] = lambda _trial, _outcome: None,
) -> list[TrialResult]:
    """Run trials on `workers` threads, each on a twin of its own.

    Args:
        arm: An iiwa with its home posture.
        settings: The world's numbers.
        controller: Constants of the control step.
        policy: What decides.
        trials: Conditions.
        duration: Length of a trial [s].
        seed: Master seed.
        workers: Number of threads; the results do not depend on it.
        guard: The rules that end a trial; none where there are none.
        done: Called with each trial that is finished, from its thread.

    Returns:
        The outcomes, in the order of the trials.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    servo = make_servo_params(arm, settings)
    longest, nothing = round(duration / controller.h), new_trial_record(0, len(arm.joints))

    def outcome(trial: Trial) -> TrialResult:
        twin = Twin(arm, trial.pendulum, settings, seed=seed, index=trial.number, servo=servo)
        start, watching = (trial.phi, trial.phi_dot), new_trial_monitor(arm, guard)
        result = _run(twin, controller, policy, start, longest, watching, nothing)
        done(trial, result)
        return result

    if workers == 1:
        return [outcome(trial) for trial in trials]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(outcome, trials))


def record_trial(
    arm: Arm,
    settings: TwinSettings,
    controller: ControllerParams,
    policy: PolicyKernel,
    pendulum: PendulumParameters,
    *,
    phi: float,
    phi_dot: float,
    duration: float,
    seed: int,
    guard: SafetyParams | None = None,
) -> tuple[TrialResult, TrialRecord, float]:
    """Run one trial and record it.

    Args:
        arm: An iiwa with its home posture.
        settings: The world's numbers.
        controller: Constants of the control step.
        policy: What decides.
        pendulum: The pendulum, with the friction that acts in the twin.
        phi: Angle of the pendulum from upright at the release [rad].
        phi_dot: Its rate [rad/s].
        duration: Length of the trial [s].
        seed: Master seed.
        guard: The rules that end it; none where there are none.

    Returns:
        The outcome, a row for each step, and what the encoder reads too much of phi [rad].

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    longest = round(duration / controller.h)
    twin, rows = (
        Twin(arm, pendulum, settings, seed=seed),
        new_trial_record(longest, len(arm.joints)),
    )
    watching = new_trial_monitor(arm, guard)
    outcome = _run(twin, controller, policy, (phi, phi_dot), longest, watching, rows)
    return outcome, TrialRecord(*(row[: outcome.steps] for row in rows)), twin.kernel.sensors.zero


def _run(
    twin: Twin,
    controller: ControllerParams,
    policy: PolicyKernel,
    start: tuple[float, float],
    longest: int,
    watching: TrialSafetyMonitor,
    rows: TrialRecord,
) -> TrialResult:
    memory, limits = new_controller_state(), boxes()
    steps, cause, sum_x2 = run_trial(
        twin.kernel, controller, memory, policy, *start, longest, limits, watching, rows
    )
    return TrialResult(int(steps), int(cause), float(sum_x2))
