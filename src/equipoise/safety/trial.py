"""Safety rules of a rig in trials of the digital twin: a broken rule ends a trial.

The functions are those of `equipoise.safety.rules`, compiled. They receive the inputs of a rig's
controller: measured joints, the observer's estimate, the setpoints sent. Rules about clocks, links
and cables do not apply to a trial; external torques are left out, since nothing touches its arm.
"""

from collections.abc import Sequence
from math import inf
from typing import Annotated, Final, NamedTuple, Protocol

from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arm.compiler import FRAME_SIZE
from equipoise.arrays import Array, Records, new_records
from equipoise.control.control_step import (
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    kinematics,
)
from equipoise.control.controller import flange_pose
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import compilable, inlined
from equipoise.model.actuator import ROWS
from equipoise.safety import rules
from equipoise.safety.rules import NO_VIOLATION, Limits, SafetyParams

SETPOINT_HISTORY: Final = 64
"""Number of setpoints in memory: 0.32 s, more than delay and age of a reply together."""


class MonitorState(Protocol):
    """State of the safety rules in a trial; kernels change it in place."""

    sent: Annotated[Array, (SETPOINT_HISTORY,)]
    """Times of the last setpoints [s], each at its number modulo `SETPOINT_HISTORY`."""
    setpoints: Annotated[Array, (SETPOINT_HISTORY, FREE_JOINTS)]
    """Their free joints [rad]."""
    error_time: float
    """Duration of a following error beyond its limit [s]."""
    number: int
    """Number of setpoints sent."""
    still: Annotated[Array, ROWS]
    """Velocities of zero."""
    frame: Annotated[Array, (FRAME_SIZE, BATCH_SIZE)]
    """Record of the measured flange."""


class TrialSafetyMonitor(NamedTuple):
    """Safety rules with their state in a trial, for kernels."""

    active: bool
    """Whether any rule applies."""
    params: SafetyParams
    """Safety limits; those of joints and torques for the free joints alone."""
    states: Records
    """`MonitorState`."""


def new_trial_monitor(arm: Arm, params: SafetyParams, *, active: bool = True) -> TrialSafetyMonitor:
    """Return the monitor of a trial before its start; where it is not active no rule applies."""
    limits = Limits(*(arm.without_held(row) for row in params.limits))
    params = params._replace(limits=limits, torque=arm.without_held(params.torque))
    return TrialSafetyMonitor(active, params, new_records(MonitorState))


@compilable
def reset_trial_monitor(monitor: TrialSafetyMonitor, q: Sequence[float]) -> None:
    """Begin with an arm that rests at the free joints `q` [rad]."""
    state = monitor.states[0]
    # Rules need the last two setpoints; earlier ones do not matter.
    for row in range(2):
        state.sent[row] = -inf
        for i in range(FREE_JOINTS):
            state.setpoints[row, i] = q[i]
    state.number = 2
    state.error_time = 0.0


@inlined
def setpoint_violation(monitor: TrialSafetyMonitor, q: Array, now: float) -> int:
    """Return the code of the rule that forbids a setpoint, `NO_VIOLATION` if none.

    An accepted setpoint is stored.

    Args:
        monitor: Changed in place.
        q: The free joints [rad], shape (6,).
        now: The time [s].
    """
    params, state = monitor.params, monitor.states[0]
    setpoints, count = state.setpoints, state.number
    last = setpoints[(count - 1) % SETPOINT_HISTORY]
    before = setpoints[(count - 2) % SETPOINT_HISTORY]
    dt = params.h / SETPOINTS_PER_TICK
    code, _, _, _ = rules.broken_setpoint(params.limits, q, last, before, dt)
    if code == NO_VIOLATION:
        state.sent[count % SETPOINT_HISTORY] = now
        for i in range(FREE_JOINTS):
            setpoints[count % SETPOINT_HISTORY, i] = q[i]
        state.number = count + 1
    return code


@inlined
def trial_violation(
    monitor: TrialSafetyMonitor,
    controller: ControllerParams,
    measurements: ControllerState,
    q: Array,
    measured_at: float,
) -> int:
    """Return the code of the rule that ends the trial at this tick, `NO_VIOLATION` if none.

    Args:
        monitor: Changed in place.
        controller: Constants.
        measurements: Measured joints and the estimate, of the first lane.
        q: The measured free joints once more [rad], shape (6,).
        measured_at: Time of their measurement [s].
    """
    params, state = monitor.params, monitor.states[0]
    since = measured_at - params.reaction
    expected = state.setpoints[rules.newest_before(state.sent, state.number, since)]
    error, _ = rules.largest_difference(q, expected)
    state.error_time = rules.next_error_time(state.error_time, error, params.h)
    if state.error_time > rules.FOLLOWING_TIME:
        return rules.FOLLOWING_CODE
    kinematics(controller.kinematics, measurements.measured, state.still, state.frame, 1)
    x, drift, tilt, w = flange_pose(state.frame, controller.home_reference)
    x_dot, phi = measurements.estimate.pivot_v[0], measurements.estimate.phi[0]
    code, _, _ = rules.broken_flange(params, x, x_dot, drift, tilt, w)
    balancing = measurements.balancing[0] != 0
    if code == NO_VIOLATION and balancing and rules.has_fallen(phi):
        return rules.ANGLE_CODE
    return code
