"""Refine: logs of a balancing policy say whether its model still holds, and its table learns on.

This is the future work of Safeea & Neto: from the robot back to the simulation. A log holds what
was sent to the joints, what they did, and what the encoder counted. From it come again

1. the pendulum: w2, k and c (`equipoise.identification.closed_loop`). The pivot is where the
   measured joints carry it, and phi in space is the encoder's plus the tilt of the flange;
2. the actuator: delay, cycle, and the lags of the joints that move. Balancing moves few; the
   others keep what was known.

What differs beyond both 95 % intervals, and by more than training varies anyway, has moved. With
the new values training goes on from the old table and its visits. Of old and new table the one is
kept that does better on the new model, in trials by which neither was chosen.
"""

from collections.abc import Callable, Mapping, Sequence
from math import hypot, sqrt
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import Estimate, Value
from equipoise.control.policy import Checkpoint, TabularPolicy
from equipoise.errors import ArtefactError, RecordingError
from equipoise.identification.actuator import LEAST_SPEED, identify_actuator, speed_ranges
from equipoise.identification.closed_loop import ClosedLoopFit, ParameterChange, compare, regress
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.encoder import theta_from_counts
from equipoise.model.pendulum import Pendulum
from equipoise.settings import PlantSettings, Settings
from equipoise.training import Report, Selecting, score_policy, train

Array = npt.NDArray[np.float64]

EPISODES: Final = 2000
"""Episodes of a retraining."""
EXPLORATION: Final = 0.2
"""A retraining explores by this share of what the training did: its table knows much already."""
FRESH: Final = 1 << 32
"""Added to the seed for the trials that compare old and new: no training can have such a seed."""
SPACING: Final = 0.01
"""So far apart the samples of an encoder are worth fitting [s]: a tick, as in a log of a twin."""
NORMAL: Final = 1.96
"""Half a 95 % interval, in standard deviations."""
DISAGREED: Final = 3.0
"""A warning is given where w2 differs so many times more between runs than their intervals say."""
NO_DRAG: Final = Estimate(value=0.0, low=0.0, high=0.0, source="assumed")
"""Balancing is too slow for the drag of the air."""


class ModelMotion(NamedTuple):
    """A run as the pendulum went through it; each of shape (n,)."""

    time: Array
    """Time stamps of the encoder [s]."""
    phi: Array
    """Angle of the pendulum from upright, in space [rad]."""
    x: Array
    """Displacement of the pivot along base x [m]."""


class ArmResponse(Value):
    """A number of the actuator that logs find elsewhere than it was."""

    name: str
    """`delay`, `cycle`, or `lag of` a joint."""
    before: Estimate
    """What was known [s]."""
    now: Estimate
    """What the logs say [s]."""
    z: float
    """Difference in standard deviations of both."""

    @property
    def text(self) -> str:
        """One line for a person."""
        before, now = (
            f"{1e3 * e.value:.3g} [{1e3 * e.low:.3g}, {1e3 * e.high:.3g}]"
            for e in (self.before, self.now)
        )
        return (
            f"{self.name} moved from {before} to {now} ms (95 % intervals, z = {self.z:.1f}): "
            "the arm follows its setpoints otherwise"
        )


class RefinementFindings(Value):
    """What logs say about the model of a policy."""

    fit: ClosedLoopFit
    """The pendulum of the logs."""
    response: dict[str, Estimate]
    """The actuator of the logs, by name, as far as they tell it [s]."""
    moves: tuple[ParameterChange | ArmResponse, ...]
    """What moved; empty where the model still holds."""
    pendulum: Pendulum
    """That of the policy, but for what moved."""
    actuator: Actuator
    """That of the policy; if any of it moved, with all that the logs tell."""
    warnings: tuple[str, ...]
    """Where the logs say little, and what to do."""


class Refinement(NamedTuple):
    """A policy for the model that was found."""

    policy: TabularPolicy
    """The one that was kept."""
    kept: Literal["old", "new"]
    """Whose table it has."""
    old: Checkpoint
    """How the old table does on the model."""
    new: Checkpoint
    """How the new table does in the same trials."""


def inspect(policy: TabularPolicy, logs: Mapping[str, RunLog]) -> RefinementFindings:
    """Return what logs say about the model of a policy.

    Args:
        policy: The policy, with its pendulum, arm and actuator.
        logs: Runs on one rig, by name; at least one.

    Returns:
        What was found, and what of it moved.

    Raises:
        ArtefactError: A log is of another arm.
        RecordingError: A log identifies no pendulum.
    """
    plant, arm = policy.settings.plant, policy.arm
    fits: list[ClosedLoopFit] = []
    responses: list[dict[str, Estimate]] = []
    warnings: list[str] = []
    for name, log in logs.items():
        try:
            fits.append(regress(*thinned(read_motion(log, arm)), g=policy.pendulum.g))
        except (ArtefactError, RecordingError) as error:
            raise type(error)(f"{name}: {error}") from None
        warnings += (f"{name}: {warning}" for warning in fits[-1].warnings)
        # Where the arm is taken to follow at once, there is no actuator to compare with.
        if not plant.ideal:
            try:
                responses.append(read_response(log, arm, policy.actuator))
            except RecordingError as error:
                warnings.append(f"{name} does not tell the actuator: {error}")
    if len(fits) > 1 and disagreement([each.w2 for each in fits]) > DISAGREED:
        found = ", ".join(f"{each.w2.value:.4g}" for each in fits)
        warnings.append(
            f"the runs do not agree about w2 ({found} 1/s^2): the pendulum changed between them, "
            "and their mean is known badly; give runs of one pendulum"
        )
    fit = combine_fits(fits)
    response = {
        name: combine([each[name] for each in responses if name in each])
        for name in numbers(policy.actuator, arm)
        if any(name in each for each in responses)
    }
    moves = compare(policy.pendulum, fit, plant)
    responded = compare_responses(policy.actuator, response, arm, plant)
    return RefinementFindings(
        fit=fit,
        response=response,
        moves=(*moves, *responded),
        pendulum=_moved_pendulum(policy.pendulum, fit, moves),
        actuator=_moved_actuator(policy.actuator, response, arm) if responded else policy.actuator,
        warnings=tuple(warnings),
    )


def retrain(
    policy: TabularPolicy,
    pendulum: Pendulum,
    actuator: Actuator,
    *,
    episodes: int = EPISODES,
    seed: int = 0,
    workers: int = 1,
    partial: Path | None = None,
    report: Report = lambda _: None,
    selecting: Selecting = lambda _, __: None,
    done: Callable[[int], None] = lambda _: None,
) -> Refinement:
    """Train a policy on for another model, and keep the better of old and new table.

    Args:
        policy: The policy, whose table and visits are the start.
        pendulum: The pendulum to balance.
        actuator: How the arm follows its setpoints.
        episodes: How many more.
        seed: Master seed.
        workers: Threads; the result does not depend on it.
        partial: File for checkpoints of the training, as in `train`.
        report: Called with each new point of the learning curve.
        selecting: Called as the trials of the final selection finish, as in `train`.
        done: Called with the number of trials that have just finished in which old and new table
            are compared; `compared_trials` of them in all.

    Returns:
        The policy that was kept, and how both did.
    """
    new = train(
        pendulum,
        policy.arm,
        settings_of_retraining(policy.settings, episodes),
        actuator=actuator,
        seed=seed,
        init_policy=policy,
        workers=workers,
        partial=partial,
        report=report,
        selecting=selecting,
    )
    old = policy.model_copy(update={"pendulum": pendulum, "actuator": actuator})
    of_old, of_new = (
        score_policy(each, seed=seed + FRESH, workers=workers, done=done) for each in (old, new)
    )
    if of_new.score > of_old.score:
        return Refinement(new, "new", of_old, of_new)
    return Refinement(old.model_copy(update={"checkpoints": (of_old,)}), "old", of_old, of_new)


def compared_trials(policy: TabularPolicy) -> int:
    """Return the number of trials in which `retrain` compares the old and the new table."""
    return 2 * policy.settings.selection.final_trials


def settings_of_retraining(settings: Settings, episodes: int) -> Settings:
    """Return the settings of a retraining, from those of the training."""
    learning = settings.learning
    changes = {
        "episodes": episodes,
        "epsilon_initial": EXPLORATION * learning.epsilon_initial,
    }
    return settings.model_copy(update={"learning": learning.model_copy(update=changes)})


def read_motion(log: RunLog, arm: Arm) -> ModelMotion:
    """Return how pendulum and pivot moved in a run, as encoder and joints measured it.

    Args:
        log: A run on a rig.
        arm: Its arm, with the home posture of the run.

    Raises:
        ArtefactError: The log is of another arm.
        RecordingError: Nothing was measured.
    """
    from scipy.interpolate import CubicSpline

    conditions = log.conditions
    # The iiwa 7 and the iiwa 14 have joints of the same names.
    of_policy = (arm.name, tuple(joint.name for joint in arm.joints), arm.held_joint)
    ran = conditions.arm
    if (ran.name, conditions.joints, ran.held_joint) != of_policy:
        raise ArtefactError(
            f"the run was on an {ran.name} with joint {ran.held_joint} held, and the "
            f"policy is for an {arm.name} with joint {arm.held_joint} held; give a run on that arm"
        )
    # A sample that nothing newer came after is read again in the next tick.
    time, first = np.unique(log.encoder.time, return_index=True)
    measured, of = np.unique(log.replies.time, return_index=True)
    if conditions.counts_per_rev is None or min(len(time), len(measured)) < 2:
        raise RecordingError(
            f"the log holds {len(time)} encoder counts and {len(measured)} measured postures (world"
            f" {conditions.world}), expected a run on a rig; run the policy on one, or on a twin"
        )
    theta = theta_from_counts(log.encoder.counts[first].astype(float), conditions.counts_per_rev, 1)
    phi = np.mod(2.0 * np.pi - theta, 2.0 * np.pi) - np.pi
    pivot = CubicSpline(measured, _pivot(log.replies.q[of], arm))
    inside = (time >= measured[0]) & (time <= measured[-1])
    x, tilt = pivot(time[inside]).T
    return ModelMotion(time[inside], phi[inside] + tilt, x)


def thinned(motion: ModelMotion) -> ModelMotion:
    """Return a motion with means of neighbouring samples, about `SPACING` apart.

    A board sends each millisecond, with stamps that are wrong by a third of that: splines through
    all of them see the stamps. The equation of the pendulum is linear enough for its terms to be
    averaged alike.
    """
    if len(motion.time) < 2:
        return motion
    every = max(round(SPACING / float(np.median(np.diff(motion.time)))), 1)
    whole = len(motion.time) // every * every
    return ModelMotion(*(part[:whole].reshape(-1, every).mean(axis=1) for part in motion))


def _pivot(q: Array, arm: Arm) -> Array:
    """Return x of the pivot from home [m], and the tilt of the flange [rad], shape (n, 2).

    The tilt is a turn about base y, along which the spindle lies: what the encoder does not see.

    Args:
        q: All joints [rad], shape (n, joints).
        arm: The arm.
    """
    free = list(arm.free)
    poses = [arm.pose(posture) for posture in q[:, free]]
    position = np.array([pose.position for pose in poses])
    rotation = np.array([pose.rotation for pose in poses])
    home, outward = arm.pose(arm.home_free), np.array(arm.pivot)
    x = (position + rotation @ outward - home.position - home.rotation @ outward)[:, 0]
    turn = rotation @ home.rotation.T
    return np.stack([x, np.arctan2(turn[:, 0, 2], turn[:, 2, 2])], axis=1)


def read_response(log: RunLog, arm: Arm, known: Actuator) -> dict[str, Estimate]:
    """Return what a run tells of the actuator, by name [s].

    Args:
        log: A run on a rig.
        arm: Its arm.
        known: An actuator of the kind that is looked for.

    Raises:
        RecordingError: The joints hardly moved, or did not follow their setpoints.
    """
    free = list(arm.free)
    sent, q = log.stream.q[:, free], log.replies.q[:, free]
    moving = np.flatnonzero(speed_ranges(log.stream.time, sent) >= LEAST_SPEED).tolist()
    if not moving:
        raise RecordingError(
            f"no joint's velocity ranges over {LEAST_SPEED} rad/s; let the pendulum move more, or "
            "record a run with equipoise deploy --excite"
        )
    # The fit takes six joints that move: the first that does stands in for those that do not.
    joints = [j if j in moving else moving[0] for j in range(FREE_JOINTS)]
    actuator = identify_actuator(
        log.stream.time,
        sent[:, joints],
        log.replies.time,
        q[:, joints],
        source=log.digest,
        kind=known.kind,
    )
    still = {_lag(arm, j) for j in range(FREE_JOINTS) if j not in moving}
    return {
        name: estimate
        for name, estimate in numbers(actuator, arm).items()
        if name not in still and estimate.source == "identified"
    }


def numbers(actuator: Actuator, arm: Arm) -> dict[str, Estimate]:
    """Return delay, cycle and lags of an actuator by name [s]."""
    lags = {_lag(arm, j): lag for j, lag in enumerate(actuator.lags)}
    return {"delay": actuator.delay, "cycle": actuator.cycle, **lags}


def _lag(arm: Arm, joint: int) -> str:
    return f"lag of {arm.free_joints[joint].name}"


def compare_responses(
    known: Actuator, response: Mapping[str, Estimate], arm: Arm, plant: PlantSettings
) -> tuple[ArmResponse, ...]:
    """Return which numbers of an actuator moved since it was identified.

    As for the pendulum, a number moved where the difference is beyond both 95 % intervals,
    corrected for how many are looked at, and beyond what training varies anyway. That a delay
    varies makes up for lags, too: to slow motion both are the same.

    Args:
        known: The actuator as it was identified.
        response: What logs say, by name [s].
        arm: The arm.
        plant: How far training varies delay and lags.
    """
    from scipy.stats import norm

    limit = float(norm.isf(0.025 / max(len(response), 1)))
    moves: list[ArmResponse] = []
    for name, before in numbers(known, arm).items():
        if name not in response:
            continue
        now = response[name]
        varied = 0.0 if name == "cycle" else plant.delay_spread
        varied += 0.0 if name == "delay" else plant.lag_spread * before.value
        difference = abs(now.value - before.value)
        z = difference / hypot(_sigma(before), _sigma(now))
        if z > limit and difference > varied:
            moves.append(ArmResponse(name=name, before=before, now=now, z=z))
    return tuple(moves)


def combine(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean of estimates, weighted by how well each is known.

    Where they differ by more than their intervals say, its interval is wider by as much: what they
    measure varies from log to log.

    Args:
        estimates: At least one, each with an interval that has a width.
    """
    if len(estimates) == 1:
        return estimates[0]
    values, halves, weights = _table(estimates)
    mean = float(weights @ values / np.sum(weights))
    wider = max(disagreement(estimates), 1.0)
    below, above = (wider / np.sqrt(np.sum(halves**-2.0, axis=0))).tolist()
    return Estimate(value=mean, low=mean - below, high=mean + above, source="identified")


def disagreement(estimates: Sequence[Estimate]) -> float:
    """Return how far estimates differ, in units of what their intervals say (the ratio of Birge).

    Args:
        estimates: At least two.
    """
    values, _, weights = _table(estimates)
    mean = float(weights @ values / np.sum(weights))
    return NORMAL * sqrt(float(weights @ (values - mean) ** 2) / (len(values) - 1))


def _table(estimates: Sequence[Estimate]) -> tuple[Array, Array, Array]:
    """Return values, halves of the intervals below and above, and weights of estimates."""
    table = np.array([(e.value, e.value - e.low, e.high - e.value) for e in estimates])
    return table[:, 0], table[:, 1:], 1.0 / np.mean(table[:, 1:], axis=1) ** 2


def combine_fits(fits: Sequence[ClosedLoopFit]) -> ClosedLoopFit:
    """Return what several logs of one pendulum say together; at least one."""
    if len(fits) == 1:
        return fits[0]
    names = (name for name, value in fits[0] if isinstance(value, Estimate))
    samples = np.array([fit.samples for fit in fits])

    def mean(values: Sequence[float]) -> float:
        return float(np.average(values, weights=samples))

    changes: dict[str, Any] = {name: combine([getattr(f, name) for f in fits]) for name in names}
    changes |= {
        "rate": mean([fit.rate for fit in fits]),
        "unexplained": sqrt(mean([fit.unexplained**2 for fit in fits])),
        "duration": sum(fit.duration for fit in fits),
        "samples": sum(fit.samples for fit in fits),
        "blocks": sum(fit.blocks for fit in fits),
        "warnings": tuple(warning for fit in fits for warning in fit.warnings),
    }
    return fits[0].model_copy(update=changes)


def _moved_pendulum(
    known: Pendulum, fit: ClosedLoopFit, moves: Sequence[ParameterChange]
) -> Pendulum:
    """Return the pendulum with what moved; what was weighed apart may have changed with it."""
    covariance = np.array(known.covariance)
    changes: dict[str, Any] = {}
    for move in moves:
        if move.name == "w2":
            found = {"w2": fit.w2, "k": fit.k}
            changes |= {"mass": None, "length": None, "inertia": None}
        else:
            found = {
                "c": fit.c.not_negative(),
                "coulomb": fit.coulomb.not_negative(),
                "drag": NO_DRAG,
            }
            changes |= {"friction_model": "coulomb"}
        changes |= {"fit": None, "friction": None, **found}
        for place, name in enumerate(("w2", "c", "coulomb", "drag")):
            if name in found:
                covariance[place, :] = covariance[:, place] = 0.0
                covariance[place, place] = _sigma(found[name]) ** 2
    return known.model_copy(update=changes | {"covariance": tuple(map(tuple, covariance.tolist()))})


def _moved_actuator(known: Actuator, response: dict[str, Estimate], arm: Arm) -> Actuator:
    """Return the actuator with all that logs tell: its numbers were found together."""
    now = numbers(known, arm) | response
    return known.model_copy(
        update={
            "delay": now["delay"],
            "cycle": now["cycle"],
            "lags": tuple(now[_lag(arm, j)] for j in range(FREE_JOINTS)),
            "fit": None,
        }
    )


def _sigma(estimate: Estimate) -> float:
    return (estimate.high - estimate.low) / (2.0 * NORMAL)
