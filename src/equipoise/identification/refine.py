"""Refinement of a policy's model from the log of a run.

This is the future work of Safeea & Neto: from the robot back to the simulation. A log holds the
setpoints of the joints, their measured angles, and the encoder's counts. From these are identified

1. the pendulum's w2 (`equipoise.identification.regression`). The pivot follows from the measured
   joints; phi in space is the encoder's angle plus the tilt of the flange;
2. the actuator: delay, cycle, and the lags of the joints that move. Balancing moves few joints; the
   others keep their lags.

A parameter has moved if it differs beyond both 95 % intervals, corrected for the number of
parameters, and beyond the range of the training.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from equipoise.arrays import Array
from equipoise.artefacts import Estimate
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError, RecordingError
from equipoise.identification.actuator import LEAST_SPEED, identify_actuator, speed_ranges
from equipoise.identification.regression import ClosedLoopFit, regress
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.encoder import theta_from_counts
from equipoise.model.pendulum import Pendulum
from equipoise.settings import PlantSettings

NORMAL: Final = 1.96
"""Half width of a 95 % interval in standard deviations [-]."""


class ModelMotion(NamedTuple):
    """Measured motion of pendulum and pivot; each of shape (n,)."""

    time: Array
    """Time stamps of the encoder [s]."""
    phi: Array
    """Angle of the pendulum from upright, in space [rad]."""
    x: Array
    """Displacement of the pivot along base x [m]."""


class RefinementFindings(NamedTuple):
    """Model of a policy as identified from a log."""

    fit: ClosedLoopFit
    """The identified pendulum."""
    response: dict[str, Estimate]
    """The identified parameters of the actuator, by name [s]."""
    moves: dict[str, str]
    """A line on each parameter that moved, by name; empty if the model still holds."""
    pendulum: Pendulum
    """The policy's pendulum, with w2 and k of the log if w2 moved."""
    actuator: Actuator
    """The policy's actuator, with all identified parameters if any of them moved."""
    warnings: tuple[str, ...]
    """Limitations of the log, each with advice."""


def inspect(policy: TabularPolicy, log: RunLog) -> RefinementFindings:
    """Identify the model of a policy from the log of a run, and compare.

    Args:
        policy: The policy, with its pendulum, arm and actuator.
        log: A run on a rig.

    Raises:
        ArtefactError: The log is of another arm.
        RecordingError: The log identifies no pendulum.
    """
    plant, arm, pendulum, actuator = (
        policy.settings.plant,
        policy.arm,
        policy.pendulum,
        policy.actuator,
    )
    motion = read_motion(log, arm)
    # A board sends every millisecond, with stamps that err by a third of that, which a spline
    # through all samples would fit. The equation of the pendulum is nearly linear, so that averages
    # of its terms over about 10 ms satisfy it.
    every = max(round(0.01 / float(np.median(np.diff(motion.time)))), 1)
    whole = len(motion.time) // every * every
    fit = regress(*(part[:whole].reshape(-1, every).mean(axis=1) for part in motion), g=pendulum.g)
    response: dict[str, Estimate] = {}
    warnings = list(fit.warnings)
    # An ideal arm has no actuator to compare with.
    if not plant.ideal:
        try:
            response = read_response(log, arm, actuator)
        except RecordingError as error:
            warnings.append(f"the log does not identify the actuator: {error}")
    # The friction of a balanced pendulum is hardly known, and not compared.
    of_w2 = (pendulum.w2, fit.w2, plant.inertia_sigma * pendulum.w2.value)
    moves = significant_moves({"w2": of_w2}, "1/s^2")
    responded = actuator_moves(actuator, response, arm, plant)
    if moves:
        covariance = np.array(pendulum.covariance)
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = (fit.w2.half_width / NORMAL) ** 2
        changes = {"w2": fit.w2, "k": fit.k, "covariance": tuple(map(tuple, covariance.tolist()))}
        # A new inertia has no mass and length.
        gone = dict.fromkeys(("fit", "friction", "mass", "length", "inertia"))
        pendulum = pendulum.model_copy(update=changes | gone)
    if responded:
        delay, cycle, *lags = (_numbers(actuator, arm) | response).values()
        new = {"delay": delay, "cycle": cycle, "lags": tuple(lags), "fit": None}
        actuator = actuator.model_copy(update=new)
    moved = moves | responded
    return RefinementFindings(fit, response, moved, pendulum, actuator, tuple(warnings))


def read_motion(log: RunLog, arm: Arm) -> ModelMotion:
    """Return the motion of pendulum and pivot from the measurements of encoder and joints.

    Args:
        log: A run on a rig.
        arm: Its arm, with the home posture of the run.

    Raises:
        ArtefactError: The log is of another arm.
        RecordingError: The log has no measurements.
    """
    from scipy.interpolate import CubicSpline

    conditions, ran = log.conditions, log.conditions.arm
    # The iiwa 7 and the iiwa 14 have joints of the same names.
    of_policy = (arm.name, tuple(joint.name for joint in arm.joints), arm.held_joint)
    if (ran.name, conditions.joints, ran.held_joint) != of_policy:
        raise ArtefactError(
            f"the run was on an {ran.name} with joint {ran.held_joint} held, and the "
            f"policy is for an {arm.name} with joint {arm.held_joint} held; give a run on that arm"
        )
    # A tick without a new sample reads the previous one again.
    time, first = np.unique(log.encoder.time, return_index=True)
    measured, of = np.unique(log.replies.time, return_index=True)
    inside = (time >= np.min(measured, initial=np.inf)) & (
        time <= np.max(measured, initial=-np.inf)
    )
    if conditions.counts_per_rev is None or np.count_nonzero(inside) < 2 or len(measured) < 2:
        raise RecordingError(
            f"the log holds {len(time)} encoder counts and {len(measured)} measured postures (world"
            f" {conditions.world}), expected a run on a rig; run the policy on one, or on a twin"
        )
    theta = theta_from_counts(log.encoder.counts[first].astype(float), conditions.counts_per_rev, 1)
    phi = np.mod(2.0 * np.pi - theta, 2.0 * np.pi) - np.pi
    x, tilt = CubicSpline(measured, _pivot(log.replies.q[of], arm))(time[inside]).T
    return ModelMotion(time[inside], phi[inside] + tilt, x)


def _pivot(q: Array, arm: Arm) -> Array:
    """Return x of the pivot from home [m], and the tilt of the flange [rad], shape (n, 2).

    The tilt is a rotation about base y, the axis of the spindle; the encoder does not measure it.

    Args:
        q: All joints [rad], shape (n, joints).
        arm: The arm.
    """
    free = list(arm.free)
    poses = [arm.kinematics(posture) for posture in q[:, free]]
    position = np.array([pose.position for pose in poses])
    rotation = np.array([pose.rotation for pose in poses])
    home, outward = arm.kinematics(arm.home_free), np.array(arm.pivot)
    x = (position + rotation @ outward - home.position - home.rotation @ outward)[:, 0]
    turn = rotation @ home.rotation.T
    return np.stack([x, np.arctan2(turn[:, 0, 2], turn[:, 2, 2])], axis=1)


def read_response(log: RunLog, arm: Arm, known: Actuator) -> dict[str, Estimate]:
    """Return the parameters of the actuator that a run identifies, by name [s].

    Args:
        log: A run on a rig.
        arm: Its arm.
        known: An actuator of the same kind.

    Raises:
        RecordingError: The joints moved too little, or did not follow their setpoints.
    """
    free, stream, replies = np.array(arm.free), log.stream, log.replies
    speeds = speed_ranges(stream.time, stream.q[:, free])
    moving = np.flatnonzero(speeds >= LEAST_SPEED).tolist()
    if not moving:
        raise RecordingError(
            f"no joint's velocity ranges over {LEAST_SPEED} rad/s; let the pendulum move more, or "
            "record a run with equipoise deploy --excite"
        )
    # The fit needs six moving joints: the first of these replaces those at rest.
    joints = free[[j if j in moving else moving[0] for j in range(FREE_JOINTS)]]
    sent, measured = (np.column_stack((part.time, part.q[:, joints])) for part in (stream, replies))
    actuator = identify_actuator(sent, measured, source=log.digest, kind=known.kind)
    still = [f"lag of {arm.free_joints[j].name}" for j in range(FREE_JOINTS) if j not in moving]
    return {
        name: estimate
        for name, estimate in _numbers(actuator, arm).items()
        if name not in still and estimate.source == "identified"
    }


def _numbers(actuator: Actuator, arm: Arm) -> dict[str, Estimate]:
    """Return delay, cycle and lags of an actuator by name [s]."""
    lags = {
        f"lag of {joint.name}": lag
        for joint, lag in zip(arm.free_joints, actuator.lags, strict=True)
    }
    return {"delay": actuator.delay, "cycle": actuator.cycle, **lags}


def actuator_moves(
    known: Actuator, response: Mapping[str, Estimate], arm: Arm, plant: PlantSettings
) -> dict[str, str]:
    """Return a line on each parameter of an actuator that moved.

    The training's range of the delay covers lags too: to slow motion both are equivalent.

    Args:
        known: The actuator as identified before.
        response: Parameters identified from a log, by name [s].
        arm: The arm.
        plant: Ranges of delay and lags in the training.
    """
    pairs: dict[str, tuple[Estimate, Estimate, float]] = {}
    for name, now in response.items():
        before = _numbers(known, arm)[name]
        varied = 0.0 if name == "cycle" else plant.delay_spread
        varied += 0.0 if name == "delay" else plant.lag_spread * before.value
        pairs[name] = before, now, varied
    return significant_moves(pairs, "s")


def significant_moves(
    pairs: Mapping[str, tuple[Estimate, Estimate, float]], unit: str
) -> dict[str, str]:
    """Return a line on each significant change of a value beyond the range of the training.

    Args:
        pairs: Values before and now, and that range, by name.
        unit: Unit of the values.
    """
    from scipy.stats import norm

    limit = float(norm.isf(0.025 / max(len(pairs), 1)))
    moves: dict[str, str] = {}
    for name, (before, now, varied) in pairs.items():
        low, high = sorted((before, now), key=lambda estimate: estimate.value)
        # In standard deviations, from the facing halves of the intervals.
        halves = float(np.hypot(low.high - low.value, high.value - high.low))
        z = NORMAL * (high.value - low.value) / max(halves, 1e-300)
        if z > limit and high.value - low.value > varied:
            was, is_now = (f"{e.value:.4g} [{e.low:.4g}, {e.high:.4g}]" for e in (before, now))
            moves[name] = f"{name} moved from {was} to {is_now} {unit} (95 %, z = {z:.1f})"
    return moves
