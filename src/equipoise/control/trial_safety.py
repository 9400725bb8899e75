"""The rules of a run over the trials of the digital twin: what a rig would stop, ends a trial.

The functions are those of `equipoise.control.safety`, compiled; they are told what a rig's pilot is
told: measured joints, the observer's estimate, the setpoints that were sent. Rules about clocks,
links and cables have nothing to ask here, and external torques are left out: nobody touches the arm
of a trial.
"""

from math import inf
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.compiled import kernel
from equipoise.control.boxes import SAFETY_STOP
from equipoise.control.control_step import (
    EST_PHI,
    EST_PIVOT_V,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    horizon,
)
from equipoise.control.controller import flange_pose
from equipoise.control.safety import (
    ANGLE_CODE,
    FOLLOWING_CODE,
    NO_VIOLATION,
    RULES,
    T1_SPEED,
    Limits,
    SafetyParams,
    broken_flange,
    broken_setpoint,
    has_fallen,
    is_astray,
    largest_difference,
    make_safety_params,
    newest_before,
    time_astray,
)
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import FRAME_SIZE, FREE_JOINTS, Arm
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.model.sim_configs import TwinSettings

Array = npt.NDArray[np.float64]

SETPOINT_HISTORY: Final = 64
"""Setpoints that are remembered: 0.32 s, more than delay and age of a reply together."""
AT_REST_SETPOINTS: Final = 2
"""Equal setpoints say that an arm is at rest."""
_NONE: Final = (0.0,) * FREE_JOINTS
NO_SAFETY: Final = SafetyParams(Limits(_NONE, _NONE, _NONE, _NONE), _NONE, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Stands where no rule is asked."""


class TrialSafetyMonitor(NamedTuple):
    """The rules with what they remember of a trial, which kernels change in place."""

    active: bool
    """Whether any rule is asked."""
    guard: SafetyParams
    """The rules; limits and torques of the free joints alone."""
    sent: Array
    """When the last setpoints were sent [s], each at its number modulo `REMEMBERED`."""
    setpoints: Array
    """Their free joints [rad], shape (REMEMBERED, 6)."""
    number: npt.NDArray[np.int64]
    """How many there were, shape (1,)."""
    astray: Array
    """For how long some joint has been far from where it was expected [s], shape (1,)."""
    still: Array
    """Zero: room for velocities, a block of 6 rows."""
    frame: Array
    """Room for the record of the measured flange."""


def trial_safety(
    arm: Arm,
    settings: TwinSettings,
    actuator: Actuator,
    h: float,
    max_speed: float | None = None,
) -> SafetyParams | None:
    """Return the rules that act in a world, as they would on a rig; none where none do.

    Args:
        arm: The arm with its home posture.
        settings: The world's numbers.
        actuator: What the controller knows of the arm's response.
        h: Time between ticks [s].
        max_speed: What the task limits the flange's speed to [m/s]; none where it does not.
    """
    if not settings.guards:
        return None
    return make_safety_params(
        arm,
        reaction=horizon(arm, actuator, 0.0),
        u_max=paper.U_MAX,
        h=h,
        counts_per_rev=settings.counts_per_rev,
        speed=min(T1_SPEED if settings.t1 else inf, inf if max_speed is None else max_speed),
    )


def new_trial_monitor(arm: Arm, guard: SafetyParams | None) -> TrialSafetyMonitor:
    """Return rules that have seen nothing yet, for one trial; none are asked without a guard."""
    rules = NO_SAFETY
    if guard is not None:
        limits = Limits(*(arm.without_held(row) for row in guard.limits))
        rules = guard._replace(limits=limits, torque=arm.without_held(guard.torque))
    return TrialSafetyMonitor(
        active=guard is not None,
        guard=rules,
        sent=np.zeros(SETPOINT_HISTORY),
        setpoints=np.zeros((SETPOINT_HISTORY, FREE_JOINTS)),
        number=np.zeros(1, np.int64),
        astray=np.zeros(1),
        still=np.zeros(FREE_JOINTS * BATCH_SIZE),
        frame=np.zeros(FRAME_SIZE * BATCH_SIZE),
    )


@kernel
def reset_trial_monitor(watching: TrialSafetyMonitor, q: Array) -> None:
    """Begin with an arm that rests at the free joints `q` [rad], shape (6,)."""
    # The last two setpoints: what was sent before them does not matter.
    for row in range(AT_REST_SETPOINTS):
        watching.sent[row] = -inf
        for i in range(FREE_JOINTS):
            watching.setpoints[row, i] = q[i]
    watching.number[0] = AT_REST_SETPOINTS
    watching.astray[0] = 0.0


@kernel
def refused(watching: TrialSafetyMonitor, q: Array, now: float) -> int:
    """Return the code of the rule that forbids a setpoint, `NO_VIOLATION` if none.

    An accepted setpoint is remembered.

    Args:
        watching: Changed in place.
        q: The free joints [rad], shape (6,).
        now: The time [s].
    """
    guard, setpoints, count = watching.guard, watching.setpoints, watching.number[0]
    last, before = (
        setpoints[(count - 1) % SETPOINT_HISTORY],
        setpoints[(count - 2) % SETPOINT_HISTORY],
    )
    code, _, _, _ = broken_setpoint(guard.limits, q, last, before, guard.h / SETPOINTS_PER_TICK)
    if code == NO_VIOLATION:
        watching.sent[count % SETPOINT_HISTORY] = now
        for i in range(FREE_JOINTS):
            setpoints[count % SETPOINT_HISTORY, i] = q[i]
        watching.number[0] = count + 1
    return code


@kernel
def stopped(
    watching: TrialSafetyMonitor,
    controller: ControllerParams,
    memory: ControllerState,
    q: Array,
    measured_at: float,
) -> int:
    """Return which rule ends the run at this tick, `NO_VIOLATION` if none.

    Args:
        watching: Changed in place.
        controller: Constants.
        memory: Measured joints and the estimate, of the first lane.
        q: The measured free joints once more [rad], shape (6,).
        measured_at: When they were measured [s].
    """
    guard, count = watching.guard, watching.number[0]
    since = measured_at - guard.reaction
    expected = watching.setpoints[newest_before(watching.sent, count, since)]
    error, _ = largest_difference(q, expected)
    watching.astray[0] = time_astray(watching.astray[0], error, guard.h)
    if is_astray(watching.astray[0]):
        return FOLLOWING_CODE
    x, drift, tilt, w = flange_pose(
        controller.kinematics,
        memory.measured,
        watching.still,
        watching.frame,
        controller.home_reference,
    )
    x_dot = at(memory.estimate, EST_PIVOT_V, 0)
    code, _, _ = broken_flange(guard, x, x_dot, drift, tilt, w)
    if code == NO_VIOLATION and has_fallen(at(memory.estimate, EST_PHI, 0)):
        return ANGLE_CODE
    return code


def guard_named(cause: int) -> str:
    """Return which rule ended a trial, by the code of its cause; empty where none did."""
    return RULES[cause - SAFETY_STOP].value if cause >= SAFETY_STOP else ""
