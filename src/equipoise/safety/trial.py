"""Safety rules of a rig in trials of the digital twin: a broken rule ends a trial.

The functions are those of `equipoise.safety.rules`, compiled. They receive the inputs of a rig's
controller: measured joints, the observer's estimate, the setpoints sent. Rules about clocks, links
and cables do not apply to a trial; external torques are left out, since nothing touches its arm.
"""

from math import inf
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.control_step import (
    EST_PHI,
    EST_PIVOT_V,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    horizon,
)
from equipoise.control.controller import flange_pose
from equipoise.jit import called, inlined
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.arms.compiler import FRAME_SIZE
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.model.worlds import TwinSettings
from equipoise.safety import rules
from equipoise.safety.rules import NO_VIOLATION, Limits, SafetyParams

SETPOINT_HISTORY: Final = 64
"""Number of setpoints in memory: 0.32 s, more than delay and age of a reply together."""


class TrialSafetyMonitor(NamedTuple):
    """Safety rules with their state in a trial, which kernels change in place."""

    active: bool
    """Whether any rule applies."""
    params: SafetyParams
    """Safety limits; those of joints and torques for the free joints alone."""
    sent: Array
    """Times of the last setpoints [s], each at its number modulo `SETPOINT_HISTORY`."""
    setpoints: Array
    """Their free joints [rad], shape (SETPOINT_HISTORY, 6)."""
    number: npt.NDArray[np.int64]
    """Number of setpoints sent, shape (1,)."""
    error_time: Array
    """Duration of a following error beyond its limit [s], shape (1,)."""
    still: Array
    """Velocities of zero, a block of 6 rows."""
    frame: Array
    """Scratch for the record of the measured flange."""


def trial_safety(
    arm: Arm,
    settings: TwinSettings,
    actuator: Actuator,
    h: float,
    max_speed: float | None = None,
) -> SafetyParams | None:
    """Return the safety limits of a world, those of a rig; None where it has none.

    Args:
        arm: The arm with its home posture.
        settings: The world's numbers.
        actuator: Model of the arm's response in the controller.
        h: Time between ticks [s].
        max_speed: Limit of the task on the flange's speed [m/s]; None without one.
    """
    if not settings.guards:
        return None
    return rules.make_safety_params(
        arm,
        reaction=horizon(arm, actuator, 0.0),
        u_max=paper.U_MAX,
        h=h,
        counts_per_rev=settings.counts_per_rev,
        speed=min(limit or inf for limit in (settings.max_speed, max_speed)),
    )


def new_trial_monitor(arm: Arm, params: SafetyParams | None) -> TrialSafetyMonitor:
    """Return the monitor of a trial before its start; without `params` no rule applies."""
    active, none = params is not None, (0.0,) * len(arm.joints)
    # Where no rule applies, the limits are placeholders.
    rules = params or SafetyParams(Limits(none, none, none, none), none, 0.0, 0.0, 0.0, 0.0, 0.0)
    limits = Limits(*(arm.without_held(row) for row in rules.limits))
    rules = rules._replace(limits=limits, torque=arm.without_held(rules.torque))
    size, number, error_time = SETPOINT_HISTORY, np.zeros(1, np.int64), np.zeros(1)
    sent, setpoints = np.zeros(size), np.zeros((size, FREE_JOINTS))
    still, frame = np.zeros(FREE_JOINTS * BATCH_SIZE), np.zeros(FRAME_SIZE * BATCH_SIZE)
    return TrialSafetyMonitor(active, rules, sent, setpoints, number, error_time, still, frame)


@called
def reset_trial_monitor(monitor: TrialSafetyMonitor, q: Array) -> None:
    """Begin with an arm that rests at the free joints `q` [rad], shape (6,)."""
    # Rules need the last two setpoints; earlier ones do not matter.
    for row in range(2):
        monitor.sent[row] = -inf
        for i in range(FREE_JOINTS):
            monitor.setpoints[row, i] = q[i]
    monitor.number[0] = 2
    monitor.error_time[0] = 0.0


@inlined
def setpoint_violation(monitor: TrialSafetyMonitor, q: Array, now: float) -> int:
    """Return the code of the rule that forbids a setpoint, `NO_VIOLATION` if none.

    An accepted setpoint is stored.

    Args:
        monitor: Changed in place.
        q: The free joints [rad], shape (6,).
        now: The time [s].
    """
    params, setpoints, count = monitor.params, monitor.setpoints, monitor.number[0]
    last = setpoints[(count - 1) % SETPOINT_HISTORY]
    before = setpoints[(count - 2) % SETPOINT_HISTORY]
    dt = params.h / SETPOINTS_PER_TICK
    code, _, _, _ = rules.broken_setpoint(params.limits, q, last, before, dt)
    if code == NO_VIOLATION:
        monitor.sent[count % SETPOINT_HISTORY] = now
        for i in range(FREE_JOINTS):
            setpoints[count % SETPOINT_HISTORY, i] = q[i]
        monitor.number[0] = count + 1
    return code


@inlined
def trial_violation(
    monitor: TrialSafetyMonitor,
    controller: ControllerParams,
    state: ControllerState,
    q: Array,
    measured_at: float,
) -> int:
    """Return the code of the rule that ends the trial at this tick, `NO_VIOLATION` if none.

    Args:
        monitor: Changed in place.
        controller: Constants.
        state: Measured joints and the estimate, of the first lane.
        q: The measured free joints once more [rad], shape (6,).
        measured_at: Time of their measurement [s].
    """
    params, error_time = monitor.params, monitor.error_time
    since = measured_at - params.reaction
    expected = monitor.setpoints[rules.newest_before(monitor.sent, monitor.number[0], since)]
    error, _ = rules.largest_difference(q, expected)
    error_time[0] = rules.next_error_time(error_time[0], error, params.h)
    if rules.error_time_exceeded(error_time[0]):
        return rules.FOLLOWING_CODE
    kinematics, home = controller.kinematics, controller.home_reference
    x, drift, tilt, w = flange_pose(kinematics, state.measured, monitor.still, monitor.frame, home)
    x_dot = at(state.estimate, EST_PIVOT_V, 0)
    code, _, _ = rules.broken_flange(params, x, x_dot, drift, tilt, w)
    if code == NO_VIOLATION and rules.has_fallen(at(state.estimate, EST_PHI, 0)):
        return rules.ANGLE_CODE
    return code
