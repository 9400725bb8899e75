"""Fit of a policy to its rig: arm, home, response, encoder, speed, posture and room."""

from collections.abc import Callable, Iterator, Sequence
from math import degrees, floor, inf
from typing import Final

import numpy as np

from equipoise.control.policy import TaskPolicy
from equipoise.model.actuator import Actuator, describe_rotor
from equipoise.model.arms.arm import Arm
from equipoise.rig.checks.link import GOOD_ROUND_TRIP
from equipoise.rig.checks.results import Array, CheckResult, Spread, rated
from equipoise.rig.config import RigSettings
from equipoise.safety.rules import T1_SPEED

HOME_TOLERANCE: Final = 1e-6
"""Difference of a joint's angle at home beyond which two homes differ [rad]."""
PIVOT_TOLERANCE: Final = 1e-3
"""Difference of the pivot's position on the flange beyond which a warning is given [m]."""
MIN_CLEARANCE_MM: Final = 50.0
"""Minimum clearance below the tip of the hanging pendulum [mm]."""
HOME_MARGIN_DEG: Final = 5.0
"""Minimum distance of home from a joint's limits, beyond the rig's margin [deg]."""

MIN_ROTOR_INERTIA: Final = 1e-3
"""Rotor inertia of the last joint below which a warning is given [kg m^2]: a third of the load of
bracket and pendulum about it. Published estimates are 0.4 to 1.2."""


def check_fit(policy: TaskPolicy, actuator: Actuator, rig: RigSettings) -> Iterator[CheckResult]:
    """Check a policy against the description of the rig of its run.

    Args:
        policy: The policy.
        actuator: Identified response of the rig's arm.
        rig: Contents of `rig.toml`.
    """
    arm, trained = rig.described_arm, policy.arm
    name, found, cure = "policy and arm", f"{arm.name}, home {_degrees(arm.home)} deg", ""
    if trained.digest != arm.digest:
        found = f"trained on {trained.name}, the rig has {arm.name}"
        cure = "train a policy for this arm, or correct `arm` in rig.toml"
    elif max(abs(a - b) for a, b in zip(trained.home, arm.home, strict=True)) > HOME_TOLERANCE:
        name, homes = "policy and home", (_degrees(trained.home), _degrees(arm.home))
        found = f"trained at {homes[0]} deg, the rig's home is {homes[1]} deg"
        cure = "give the home of the training in rig.toml, or train for this one"
    yield CheckResult(name, "bad" if cure else "good", found, cure)
    if max(abs(a - b) for a, b in zip(trained.pivot, arm.pivot, strict=True)) > PIVOT_TOLERANCE:
        yield CheckResult(
            "pendulum's pivot",
            "warning",
            "its position on the flange differs from that of the training",
            "the flange keeps its orientation, so that the motion is the same; measure it again "
            "where it should be equal",
        )
    fits = [_check_response(policy, trained, actuator) for trained in policy.actuators]
    yield next((fit for fit in fits if fit.verdict == "good"), fits[0])
    yield from _check_rotor(actuator)
    trained_counts = policy.settings.plant.counts_per_rev
    if rig.counts_per_rev < trained_counts // 2:
        yield CheckResult(
            "encoder's resolution",
            "bad",
            f"{rig.counts_per_rev} per revolution, trained with {trained_counts}",
            "train with --set plant.counts_per_rev, or use a finer encoder",
        )
    yield from _check_home(rig)
    yield from _check_room(policy, rig)


def fitting_actuators(policy: TaskPolicy, actuator: Actuator) -> list[int]:
    """Return the numbers of a policy's actuators that an identified one fits, from zero."""
    each = enumerate(policy.actuators)
    return [i for i, one in each if _check_response(policy, one, actuator).verdict == "good"]


def _check_response(policy: TaskPolicy, trained: Actuator, actuator: Actuator) -> CheckResult:
    name, plant = "arm's response", policy.settings.plant
    cure = "train with --actuator and the file that identify makes of this rig's excitation"
    if plant.ideal or trained.kind == "ideal":
        return CheckResult(name, "bad", "the policy was trained on an ideal arm", cure)
    if actuator.kind != trained.kind:
        found = f"{actuator.kind}, trained with {trained.kind}"
        return CheckResult(name, "bad", found, cure)
    delay, expected = actuator.delay.value, trained.delay.value
    found = f"{actuator.kind}, delay {1e3 * delay:.1f} ms"
    fits = abs(delay - expected) <= plant.delay_spread
    if not fits:
        found += f", trained for {1e3 * expected:.1f} ± {1e3 * plant.delay_spread:.1f} ms"
    ratios = [
        one.value / other.value if other.value > 0.0 else 1.0
        for one, other in zip(actuator.lags, trained.lags, strict=True)
    ]
    worst = max(ratios, key=lambda ratio: abs(ratio - 1.0))
    if fits and abs(worst - 1.0) > plant.lag_spread:
        fits = False
        found += f", a lag {worst:.2f} times the trained one"
    joints = range(len(trained.lags))
    late = max((actuator.response_time(j) - trained.response_time(j) for j in joints), key=abs)
    if fits and abs(late) > plant.delay_spread:
        fits = False
        found += f", a joint responds in {1e3 * late:+.1f} ms of the trained time"
    return rated(name, "good" if fits else "bad", found, cure)


def _check_rotor(actuator: Actuator) -> Iterator[CheckResult]:
    """Check whether the drive of the last joint can hold its load against the pendulum."""
    if actuator.drive_inertia is None:
        return
    rotor = actuator.drive_inertia.rotor
    yield rated(
        "rotor of the last joint",
        "warning" if rotor[0] < MIN_ROTOR_INERTIA else "good",
        describe_rotor(rotor),
        f"with less than {MIN_ROTOR_INERTIA:g} kg m^2 each swing twists the joint: enter the load "
        "at the cabinet, or bring the pivot nearer to the joint's axis",
    )


def _check_home(rig: RigSettings) -> Iterator[CheckResult]:
    _, room = _nearest_limit(rig.described_arm, rig.described_arm.home)
    margin = rig.position_margin_deg + HOME_MARGIN_DEG
    if room < margin:
        cure = f"choose a home that is {margin:g} deg or more inside all limits"
        yield CheckResult("home", "bad", f"{room:.1f} deg from a joint's limit", cure)


def _check_room(policy: TaskPolicy, rig: RigSettings) -> Iterator[CheckResult]:
    """Check the clearance below the hanging pendulum, taken as a uniform rod."""
    if rig.table_height_mm is None:
        return
    arm, pendulum = rig.described_arm, policy.pendulum
    pose = arm.pose(arm.home_free)
    pivot = pose.position + pose.rotation @ np.array(arm.pivot)
    length = 1.5 * pendulum.g / pendulum.w2.value
    room = 1e3 * float(pivot[2] - length) - rig.table_height_mm
    yield rated(
        "room below",
        "bad" if room < MIN_CLEARANCE_MM else "good",
        f"the tip hangs {room:.0f} mm above the table",
        f"choose a home that leaves {MIN_CLEARANCE_MM:g} mm, or clear the table",
    )


def max_flange_speed(
    arm: Arm, trips: Spread, t1: bool, rule: Callable[[Arm, float], float] | None
) -> tuple[float, str]:
    """Return the flange's speed limit [m/s] and its reason; inf where nothing limits it.

    Args:
        arm: The rig's arm, with its home posture.
        trips: Round trips to the robot.
        t1: Whether the limit of T1 holds.
        rule: Rule of the robot for a slow link, see `RobotPlugin.flange_speed`.
    """
    # In whole millimetres, so that the log names this very number.
    of_link = inf
    if rule is not None and trips.p99 > GOOD_ROUND_TRIP:
        of_link = floor(1e3 * rule(arm, trips.p99)) / 1e3
    of_t1 = T1_SPEED if t1 else inf
    return (of_link, "a slow link") if of_link <= of_t1 else (of_t1, "T1")


def check_speed(policy: TaskPolicy, limit: float, reason: str) -> Iterator[CheckResult]:
    """Check whether the policy was trained for the flange's speed limit.

    Args:
        policy: The policy.
        limit: The limit [m/s]; inf without one.
        reason: Origin of the limit.
    """
    if limit == inf:
        return
    found = f"the run stops at {limit:.3g} m/s ({reason})"
    trained = policy.settings.plant.max_speed
    if trained is not None and trained <= limit:
        yield CheckResult("flange speed", "good", f"{found}; trained for {trained:g} m/s")
        return
    found += ", which the policy was not trained for"
    cure = f"train --set plant.max_speed={limit:.3g} makes a policy that keeps the limit"
    yield CheckResult("flange speed", "warning", found, cure)


def check_posture(q: Array, rig: RigSettings) -> CheckResult:
    """Check the robot's present posture.

    Args:
        q: Measured joints [rad], shape (joints,).
        rig: Contents of `rig.toml`.
    """
    name, room = _nearest_limit(rig.described_arm, q.tolist())
    return rated(
        "posture",
        "bad" if room < rig.position_margin_deg else "good",
        f"{name} is {room:.1f} deg inside its limit",
        f"move {name} by hand to {rig.position_margin_deg:g} deg or more inside its limits",
        outside=True,
    )


def _nearest_limit(arm: Arm, q: Sequence[float]) -> tuple[str, float]:
    """Return the joint nearest to one of its limits, and the distance [deg]."""
    room = [
        degrees(min(angle - joint.lower, joint.upper - angle))
        for joint, angle in zip(arm.joints, q, strict=True)
    ]
    nearest = int(np.argmin(room))
    return arm.joints[nearest].name, room[nearest]


def _degrees(q: Sequence[float]) -> str:
    return "(" + ", ".join(f"{degrees(angle):g}" for angle in q) + ")"
