"""Checks of a run before the arm moves: its request, the connected rig, the policy's time."""

from statistics import median
from time import perf_counter

from equipoise.control.controller import Controller, FlangeKinematics
from equipoise.control.policy import tick_policy
from equipoise.errors import InputError
from equipoise.rig.checks import (
    Finding,
    check_encoder,
    check_fit,
    check_link,
    check_posture,
    check_settings,
    check_speed,
    max_flange_speed,
    require,
)
from equipoise.rig.clocks import DrainingClock
from equipoise.rig.connection import Rig, check_addresses
from equipoise.rig.phases.balancing import POLICY_TIME_SHARE
from equipoise.rig.probes import listen, round_trips
from equipoise.rig.request import RunRequest


def preflight(
    request: RunRequest, rig: Rig, granted: dict[str, str]
) -> tuple[list[Finding], float]:
    """Check a connected rig, after `check_fit` of its description; nothing moves.

    A bad result refuses the run; a warning goes into the log.

    Args:
        request: The run.
        rig: The rig.
        granted: Real-time settings of the process; empty in virtual time.

    Returns:
        Result of each check, and flange speed at which the run stops [m/s] (default: inf).

    Raises:
        LinkError: Robot or encoder does not answer.
    """
    policy, settings, seconds = request.policy, request.settings, 1.0  # of each measurement
    trips = round_trips(rig.robot, DrainingClock(rig.clock, rig.sensor), seconds)
    rule = rig.plugin.flange_speed
    max_speed = max_flange_speed(settings.described_arm, trips, request.t1, rule)
    results = [
        check_link(trips),
        *check_speed(policy, max_speed),
        check_posture(rig.robot.measured(), settings),
        *check_encoder(listen(rig.sensor, rig.clock, seconds), settings),
        *check_settings(granted),
    ]
    return results, max_speed


def check_request(request: RunRequest) -> None:
    """Validate a request without its rig; the pre-flight checks the rest.

    Raises:
        InputError: Addresses, policy, actuator and `rig.toml` do not fit each other.
        SettingsError: The twin is unknown.
    """
    check_addresses(request.robot, request.encoder)
    require(check_fit(request.policy, request.actuator, request.settings))


def warm_up(request: RunRequest) -> None:
    """Run and time all code of a tick, to compile and load it before the stream starts.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay exceeds the controller's history.
        InputError: The policy raises, returns no finite number, or takes too long.
    """
    settings, policy = request.settings, tick_policy(request.policy)
    arm, params = settings.described_arm, request.controller(settings.counts_per_rev)
    controller, took = Controller(arm, params, request.policy.settings.boxes), list[float]()
    policy.reset()
    for _ in range(20):
        controller.observe(0.0, 0.0, arm.home, 0.0)
        began = perf_counter()
        u = controller.decide(policy)
        took.append(perf_counter() - began)
        controller.command(u)
    FlangeKinematics(arm, params).pose(arm.home)
    typical, limit = median(took), POLICY_TIME_SHARE * request.policy.h
    if typical > limit:
        raise InputError(
            f"{request.policy.name} takes {1e3 * typical:.1f} ms, expected at most "
            f"{1e3 * limit:.1f} ms; make it faster"
        )
