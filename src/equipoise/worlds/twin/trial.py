"""Trials of a policy on the twin: controller, servo, arm, pendulum and sensors in one kernel.

The control step is the one of training and deployment: measurements become the observation, its u
becomes two setpoints. The true state decides how a trial ends; in a world with guards, the rules of
a rig end it as well, from the rig's measurements. A trial depends on its conditions, the master
seed and its number alone.
"""

from math import pi
from typing import Any, NamedTuple

import numpy as np

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.control_step import (
    OBS_PHI,
    OBS_PHI_DOT,
    OBS_X,
    OBS_X_DOT,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    command,
    observe,
    start_controller,
)
from equipoise.control.grid import ANGLE, JOINT_LIMIT, PHI_LIMIT, SAFETY_STOP, TRACK, TRUNCATED
from equipoise.control.policy import RANDOM, PolicyKernel, act
from equipoise.jit import inlined, kernel, struct_ref
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.elementary import at, put
from equipoise.model.random import TWIN, philox, uniform
from equipoise.safety.rules import NO_VIOLATION
from equipoise.safety.trial import (
    TrialSafetyMonitor,
    reset_trial_monitor,
    setpoint_violation,
    trial_violation,
)
from equipoise.worlds.twin.physics import TICK
from equipoise.worlds.twin.twin import (
    advance,
    encoder,
    reply,
    reset,
    send_free,
    truth,
)


class TwinTrial(NamedTuple):
    """Controller and rules of a trial on the twin; kernels change its states in place."""

    params: ControllerParams
    """Constants of the controller."""
    state: ControllerState
    """State of the controller."""
    q: Array
    """Scratch array: free joints [rad], shape (6,)."""
    monitor: TrialSafetyMonitor
    """Rules of the world with their state."""


TwinHandle: Any = struct_ref("TwinHandle", __name__, ("trial",))


@kernel
def new_twin_handle(trial: TwinTrial) -> Any:
    """Return a closed loop on a twin that kernels take by reference."""
    return TwinHandle(trial)


@kernel
def release(loop: Any, twins: Array, arrays: Array, phi: float, phi_dot: float) -> None:
    """Release the pendulum, the arm at rest at home; the controller has observed it until now.

    Args:
        loop: The trial; changed in place.
        twins: The twin, see `Twin.args`, likewise.
        arrays: The engine's arrays, likewise.
        phi: Angle of the pendulum from upright [rad].
        phi_dot: Its rate [rad/s].
    """
    twin, data = twins[0], arrays[0]
    trial = loop.trial
    controller = trial.params
    reset(twin, data, twin.home, phi, phi_dot)
    counts, stamp = encoder(twin)
    shown = pi - counts * controller.resolution - stamp * phi_dot
    start_controller(controller, trial.state, 0.0, 0.0, shown, phi_dot, 0)
    reset_trial_monitor(trial.monitor, controller.home)


@inlined
def step(trial: TwinTrial, twin: np.record, data: np.record) -> int:
    """Advance by one control step: send the setpoints for u, and observe at its end.

    Args:
        trial: The state of its controller holds u; changed in place.
        twin: The twin; changed in place.
        data: The engine's arrays, likewise.

    Returns:
        The cause of failure, TRUNCATED without one.
    """
    controller, state, monitor = trial.params, trial.state, trial.monitor
    q = trial.q
    command(controller, state, 1)
    for s in range(SETPOINTS_PER_TICK):
        for i in range(FREE_JOINTS):
            q[i] = at(state.setpoints, 6 * s + i, 0)
        if monitor.active:
            broken = setpoint_violation(monitor, q, twin.now * TICK)
            if broken != NO_VIOLATION:
                return SAFETY_STOP + broken
        send_free(twin, q)
        advance(twin, data, round(controller.h / SETPOINTS_PER_TICK / TICK))
    tick = twin.now
    counts, counted = encoder(twin)
    measured = reply(twin, q)
    put(state.counts, 0, 0, counts)
    for i in range(FREE_JOINTS):
        put(state.measured, i, 0, q[i])
    observe(controller, state, tick * TICK - counted, tick * TICK - measured, 1)
    real = truth(twin, data)
    # Written so that NaN is a failure.
    if not abs(real.phi) < PHI_LIMIT:
        return ANGLE
    if not abs(real.x) < paper.X_LIMIT:
        return TRACK
    if state.limit_exceeded[0]:
        return JOINT_LIMIT
    if monitor.active:
        broken = trial_violation(monitor, controller, state, q, measured)
        if broken != NO_VIOLATION:
            return SAFETY_STOP + broken
    return TRUNCATED


@kernel
def advance_trial(loop: Any, twins: Array, arrays: Array, true_state: Array) -> int:
    """Advance a closed loop by one tick, and return the cause of the failure.

    Args:
        loop: The trial; changed in place; the state of its controller holds u.
        twins: The twin, see `Twin.args`, likewise.
        arrays: The engine's arrays, likewise.
        true_state: Receives x, x_dot, phi, phi_dot in SI units, shape (4,).
    """
    twin, data = twins[0], arrays[0]
    trial = loop.trial
    cause = step(trial, twin, data)
    state = truth(twin, data)
    for i in range(4):
        true_state[i] = state[i]
    return cause


@kernel
def run_trial(
    loop: Any,
    twins: Array,
    arrays: Array,
    policy: PolicyKernel,
    phi: float,
    phi_dot: float,
    max_steps: int,
) -> tuple[int, int, float]:
    """Run one trial.

    Args:
        loop: The trial; changed in place.
        twins: The twin, see `Twin.args`, likewise.
        arrays: The engine's arrays, likewise.
        policy: The policy.
        phi: Angle of the pendulum from upright at the release [rad].
        phi_dot: Its rate [rad/s].
        max_steps: Number of steps after which the trial is truncated.

    Returns:
        Number of steps; cause of the end: TRUNCATED, ANGLE, TRACK, JOINT_LIMIT, or from SAFETY_STOP
        on the rule; sum of x^2 over the steps [m^2].
    """
    release(loop, twins, arrays, phi, phi_dot)
    twin, data = twins[0], arrays[0]
    trial = loop.trial
    state = trial.state
    steps, cause, sum_x2 = 0, TRUNCATED, 0.0
    while steps < max_steps and cause == TRUNCATED:
        chance = 0.0
        if policy.kind == RANDOM:
            words = philox(twin.seed, twin.now, twin.index, 0, TWIN)
            chance = uniform(words[2], 0.0, 1.0)
        seen = state.observation
        x, x_dot = at(seen, OBS_X, 0), at(seen, OBS_X_DOT, 0)
        phi, phi_dot = at(seen, OBS_PHI, 0), at(seen, OBS_PHI_DOT, 0)
        state.u[0] = act(policy, x, x_dot, phi, phi_dot, chance)
        cause = step(trial, twin, data)
        steps += 1
        sum_x2 += truth(twin, data).x ** 2
    return steps, cause, sum_x2
