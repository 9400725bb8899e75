"""Pre-flight: the checks of a connected rig and a policy before the arm moves.

A bad result refuses the run; a warning goes into the log.
"""

from collections.abc import Sequence
from typing import Final

from equipoise.checks.encoder import check_encoder, listen
from equipoise.checks.fit import check_fit, check_posture, check_speed, max_flange_speed
from equipoise.checks.host import check_realtime
from equipoise.checks.link import check_link, round_trips
from equipoise.checks.results import CheckResult, Spread
from equipoise.control.policy import TaskPolicy
from equipoise.devices.realtime import RealtimeSetting
from equipoise.model.actuator import Actuator
from equipoise.rigs import DrainingClock, Rig, RigSettings

MEASURING_TIME: Final = 1.0
"""Length of each measurement, of round trips and of encoder samples [s]."""


def preflight(
    policy: TaskPolicy,
    actuator: Actuator,
    settings: RigSettings,
    rig: Rig,
    measures: Sequence[RealtimeSetting] = (),
    *,
    t1: bool = False,
) -> tuple[list[CheckResult], float]:
    """Check a connected rig and a policy against each other; nothing moves.

    Args:
        policy: The policy.
        actuator: Identified response of the rig's arm.
        settings: Contents of `rig.toml`.
        rig: The rig.
        measures: Results of the real-time settings.
        t1: Whether the speed limit of T1 holds.

    Returns:
        Result of each check, and flange speed at which the run stops [m/s] (default: inf).

    Raises:
        LinkError: Robot or encoder does not answer.
    """
    draining = DrainingClock(rig.clock, rig.sensor)
    trips = Spread.of(round_trips(rig.robot, draining, MEASURING_TIME))
    max_speed, reason = max_flange_speed(settings.described_arm, trips, t1, rig.plugin.flange_speed)
    posture = check_posture(rig.robot.measured(), settings)
    reading = listen(rig.sensor, rig.clock, MEASURING_TIME)
    results = [
        *check_fit(policy, actuator, settings),
        check_link(trips),
        *check_speed(policy, max_speed, reason),
        posture,
        *check_encoder(reading, settings.counts_per_rev),
        *check_realtime(measures),
    ]
    return results, max_speed
