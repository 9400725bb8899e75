"""Before anything moves: is this the rig that the policy was trained for, and does it answer?

Each check ends in a finding: what was found, what is expected, and what to do where it is not so. A
finding that is not good enough refuses the run; a doubtful one is a warning and goes into the log.
"""

from collections.abc import Iterator, Sequence
from math import degrees, floor, inf
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import TabularPolicy
from equipoise.control.safety import ENCODER_LATE, ENCODER_STALE, T1_SPEED
from equipoise.control.slow_link import flange_speed
from equipoise.devices.interfaces import AngleSensor, Clock
from equipoise.devices.probes import listen, round_trips
from equipoise.devices.realtime import RealtimeSetting
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.rigs import DrainingClock, Rig, RigSettings

Array = npt.NDArray[np.float64]
Verdict = Literal["good", "warning", "refused"]

LISTENING: Final = 1.0
"""How long robot and encoder are listened to, one after the other [s]."""
QUICK: Final = 0.0055
"""A round trip of up to this leaves room for two setpoints per tick of 10 ms [s]. Over a slower
link setpoints may come as seldom as replies do, and the flange's speed is limited."""
SLOW: Final = 0.009
"""Replies that come later than this would be overdue at every tick [s]."""
LEAST_RATE: Final = 200.0
"""Fewer samples in a second leave a tick without a new one too often [1/s]."""
GOOD_RATE: Final = 450.0
"""What a board at 500 Hz or more gives [1/s]."""
LOST: Final = 0.01
"""More than this share of the encoder's samples lost or rejected says that a wire is bad [-]."""
LEAST_ROOM_MM: Final = 50.0
"""What the hanging pendulum's tip has to leave below it [mm]."""
SAME: Final = 1e-6
"""Homes that differ by more than this are two [rad]."""


class PreflightCheck(NamedTuple):
    """What a check found."""

    name: str
    """What was checked."""
    verdict: Verdict
    """Whether a run may follow."""
    found: str
    """What is so."""
    cure: str
    """What to do about it; empty where all is well."""
    outside: bool = False
    """Whether the rig failed, rather than what was given."""


class Preflight(NamedTuple):
    """What was found before anything moves."""

    findings: list[PreflightCheck]
    """Each in a row of the table."""
    max_speed: float
    """The run stops where the flange reaches this [m/s]; inf where nothing limits it."""


def check_fit(
    policy: TabularPolicy, actuator: Actuator, rig: RigSettings, counts_per_rev: int
) -> Iterator[PreflightCheck]:
    """Check a policy against the rig it is to run on.

    Args:
        policy: The policy.
        actuator: How the rig's arm follows, as it was identified.
        rig: What `rig.toml` says.
        counts_per_rev: What the encoder says.
    """
    arm, trained = rig.described_arm, policy.arm
    if trained.digest != arm.digest:
        yield PreflightCheck(
            "policy and arm",
            "refused",
            f"trained on {trained.name}, the rig has {arm.name}",
            "train a policy for this arm, or correct `arm` in rig.toml",
        )
    elif len(trained.home) != len(arm.home) or any(
        abs(a - b) > SAME for a, b in zip(trained.home, arm.home, strict=True)
    ):
        yield PreflightCheck(
            "policy and home",
            "refused",
            f"trained at {_degrees(trained.home)} deg, the rig's home is {_degrees(arm.home)} deg",
            "give the home of the training in rig.toml, or train for this one",
        )
    else:
        yield PreflightCheck(
            "policy and arm", "good", f"{arm.name}, home {_degrees(arm.home)} deg", ""
        )
    if max(abs(a - b) for a, b in zip(trained.pivot, arm.pivot, strict=True)) > 1e-3:
        yield PreflightCheck(
            "pendulum's pivot",
            "warning",
            "its place on the flange is not that of the training",
            "the flange keeps its orientation, so that the motion is the same; measure it again "
            "where it should be equal",
        )
    yield _actuator_fits(policy, actuator)
    trained_counts = policy.settings.plant.counts_per_rev
    if counts_per_rev != rig.counts_per_rev:
        yield PreflightCheck(
            "encoder's counts",
            "refused",
            f"the board says {counts_per_rev} per revolution, rig.toml {rig.counts_per_rev}",
            "correct counts_per_rev in rig.toml, or the firmware",
        )
    elif counts_per_rev < trained_counts // 2:
        yield PreflightCheck(
            "encoder's counts",
            "refused",
            f"{counts_per_rev} per revolution, trained with {trained_counts}",
            "train with --set plant.counts_per_rev, or use a finer encoder",
        )
    else:
        yield PreflightCheck("encoder's counts", "good", f"{counts_per_rev} per revolution", "")


def _actuator_fits(policy: TabularPolicy, actuator: Actuator) -> PreflightCheck:
    name, trained, plant = "arm's response", policy.actuator, policy.settings.plant
    cure = "train with --actuator and the file that identify makes of this rig's excitation"
    if policy.settings.plant.ideal or trained.kind == "ideal":
        return PreflightCheck(name, "refused", "the policy was trained on an ideal arm", cure)
    if actuator.kind != trained.kind:
        told = f"{actuator.kind}, trained with {trained.kind}"
        return PreflightCheck(name, "refused", told, cure)
    late = actuator.delay.value - trained.delay.value
    found = f"{actuator.kind}, delay {1e3 * actuator.delay.value:.1f} ms"
    if abs(late) > plant.delay_spread:
        spread = 1e3 * plant.delay_spread
        found += f", trained for {1e3 * trained.delay.value:.1f} ± {spread:.1f} ms"
        return PreflightCheck(name, "refused", found, cure)
    ratios = [
        one.value / other.value if other.value > 0.0 else 1.0
        for one, other in zip(actuator.lags, trained.lags, strict=True)
    ]
    worst = max(ratios, key=lambda ratio: abs(ratio - 1.0))
    if abs(worst - 1.0) > plant.lag_spread:
        return PreflightCheck(
            name, "refused", f"{found}, a lag {worst:.2f} times the trained one", cure
        )
    return PreflightCheck(name, "good", found, "")


def check_link(trips: Array) -> Iterator[PreflightCheck]:
    """Judge the round trips of a link to the robot [s], shape (n,)."""
    p50, p99, most = (float(t) for t in (*np.percentile(trips, (50, 99)), trips.max()))
    found = f"p50 {1e3 * p50:.2f} ms, p99 {1e3 * p99:.2f} ms, at most {1e3 * most:.2f} ms"
    cure = "use a direct cable and no other traffic; equipoise rig doctor finds more"
    yield _finding("link to the robot", link_verdict(p99), found, cure)


def link_speed(arm: Arm, trips: Array) -> float:
    """Return how fast the flange may go over a link [m/s]; inf over a quick one.

    Args:
        arm: The rig's arm, with its home posture.
        trips: Round trips [s], shape (n,).
    """
    longest = float(np.percentile(trips, 99.0))
    # In whole millimetres, so that the log says the very number.
    return inf if longest <= QUICK else floor(1e3 * flange_speed(arm, longest)) / 1e3


def lower_limit(t1: bool, of_link: float) -> float:
    """Return what the flange stays below [m/s]: the limit of T1, if it holds, or of the link."""
    return min(T1_SPEED if t1 else inf, of_link)


def check_speed(policy: TabularPolicy, t1: bool, of_link: float) -> Iterator[PreflightCheck]:
    """Say what limits the speed of the flange, and whether the policy was trained for that.

    Args:
        policy: The policy.
        t1: Whether the limit of T1 holds.
        of_link: What the link allows [m/s].
    """
    limit = lower_limit(t1, of_link)
    if limit == inf:
        return
    why = "a slow link" if of_link <= limit else "T1"
    found = f"the run stops at {limit:.3g} m/s ({why})"
    trained = policy.settings.plant.max_speed
    if trained is not None and trained <= limit:
        yield PreflightCheck("flange speed", "good", f"{found}; trained for {trained:g} m/s", "")
        return
    cure = f"train --max-speed {limit:.3g} makes a policy that lives with it"
    yield PreflightCheck(
        "flange speed", "warning", f"{found}, which the policy was not trained for", cure
    )


def check_posture(q: Array, rig: RigSettings) -> Iterator[PreflightCheck]:
    """Look at where the robot stands.

    Args:
        q: The measured joints [rad], shape (joints,).
        rig: What `rig.toml` says.
    """
    arm, margin = rig.described_arm, rig.position_margin_deg
    room = [
        degrees(min(angle - joint.lower, joint.upper - angle))
        for joint, angle in zip(arm.joints, q.tolist(), strict=True)
    ]
    closest = int(np.argmin(room))
    name = arm.joints[closest].name
    found = f"{name} is {room[closest]:.1f} deg inside its limit"
    if room[closest] < margin:
        cure = f"move {name} by hand to {margin:g} deg or more inside its limits"
        yield PreflightCheck("posture", "refused", found, cure, outside=True)
    else:
        yield PreflightCheck("posture", "good", found, "")


def check_encoder(sensor: AngleSensor, clock: Clock) -> Iterator[PreflightCheck]:
    """Listen to the encoder.

    Raises:
        LinkError: It says nothing.
    """
    heard = listen(sensor, clock, LISTENING)
    count = len(heard.delays)
    rate, age = count / heard.seconds, float(np.percentile(heard.ages, 99.0))
    found = f"{rate:.0f} samples/s, newest {1e3 * age:.1f} ms old (p99)"
    lost = heard.missing + (heard.rejected or 0)
    if lost:
        found += f", {lost} lost or damaged"
    if heard.illegal:
        found += f", {heard.illegal} illegal transitions"
        cure = "check the encoder's supply, screen and wiring"
        yield _finding("encoder", "refused", found, cure)
        return
    cure = "use a board with native USB, or set the serial adapter's latency timer to 1 ms"
    verdict = stream_verdict(rate, age)
    if verdict == "good" and lost:
        cure = "change the cable, and keep it away from the motors'"
        verdict = line_verdict(lost, count)
    yield _finding("encoder", verdict, found, cure)


def link_verdict(p99: float) -> Verdict:
    """Judge a link by the time in which 99 of 100 round trips are done [s]."""
    return "refused" if p99 > SLOW else "warning" if p99 > QUICK else "good"


def stream_verdict(rate: float, age: float) -> Verdict:
    """Judge an encoder's stream.

    Args:
        rate: Samples in a second [1/s].
        age: What the newest sample's age stays below in 99 of 100 looks [s].
    """
    if rate < LEAST_RATE or age > ENCODER_STALE:
        return "refused"
    return "warning" if rate < GOOD_RATE or age > ENCODER_LATE else "good"


def line_verdict(lost: int, count: int) -> Verdict:
    """Judge an encoder's line by how many samples were lost or rejected, and how many came."""
    return "warning" if lost > LOST * count else "good"


def check_home(rig: RigSettings) -> Iterator[PreflightCheck]:
    """Say so where a joint has hardly any room at home."""
    arm, margin = rig.described_arm, rig.position_margin_deg
    homes = [
        min(angle - joint.lower, joint.upper - angle)
        for joint, angle in zip(arm.joints, arm.home, strict=True)
    ]
    if degrees(min(homes)) < margin + 5.0:
        yield PreflightCheck(
            "home",
            "refused",
            f"{degrees(min(homes)):.1f} deg from a joint's limit",
            f"choose a home that is {margin + 5.0:g} deg or more inside all limits",
        )


def check_room(policy: TabularPolicy, rig: RigSettings) -> Iterator[PreflightCheck]:
    """Say whether the hanging pendulum has room, taken as a uniform rod."""
    if rig.table_height_mm is None:
        return
    arm, pendulum = rig.described_arm, policy.pendulum
    pose = arm.pose(arm.home_free)
    pivot = pose.position + pose.rotation @ np.array(arm.pivot)
    length = 1.5 * pendulum.g / pendulum.w2.value
    room = 1e3 * float(pivot[2] - length) - rig.table_height_mm
    found = f"the tip hangs {room:.0f} mm above the table"
    if room < LEAST_ROOM_MM:
        cure = f"choose a home that leaves {LEAST_ROOM_MM:g} mm, or clear the table"
        yield PreflightCheck("room below", "refused", found, cure)
    else:
        yield PreflightCheck("room below", "good", found, "")


def check_machine(measures: Sequence[RealtimeSetting]) -> Iterator[PreflightCheck]:
    """Say what of real time the machine allowed."""
    for measure in measures:
        if measure.taken:
            yield PreflightCheck(measure.name, "good", measure.note, "")
        else:
            yield PreflightCheck(measure.name, "warning", "not allowed", measure.note)


def preflight(
    policy: TabularPolicy,
    actuator: Actuator,
    settings: RigSettings,
    rig: Rig,
    measures: Sequence[RealtimeSetting] = (),
    *,
    t1: bool = False,
) -> Preflight:
    """Check a connected rig and a policy against each other; nothing moves.

    Args:
        policy: The policy.
        actuator: How the rig's arm follows.
        settings: What `rig.toml` says.
        rig: The rig.
        measures: What of real time the machine allowed.
        t1: Whether the speed limit of T1 holds.

    Raises:
        LinkError: Robot or encoder does not answer.
    """
    trips = round_trips(rig.robot, DrainingClock(rig.clock, rig.sensor), LISTENING)
    of_link = link_speed(settings.described_arm, trips)
    findings = [
        *check_fit(policy, actuator, settings, rig.sensor.counts_per_rev),
        *check_home(settings),
        *check_room(policy, settings),
        *check_link(trips),
        *check_speed(policy, t1, of_link),
        *check_posture(rig.robot.measured(), settings),
        *check_encoder(rig.sensor, rig.clock),
        *check_machine(measures),
    ]
    return Preflight(findings, lower_limit(t1, of_link))


def _finding(name: str, verdict: Verdict, found: str, cure: str) -> PreflightCheck:
    """Return a finding about the rig, with its cure where one is needed."""
    good = verdict == "good"
    return PreflightCheck(name, verdict, found, "" if good else cure, verdict == "refused")


def _degrees(q: Sequence[float]) -> str:
    return "(" + ", ".join(f"{degrees(angle):g}" for angle in q) + ")"
