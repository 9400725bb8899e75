"""Checks of a run before the arm moves: its request, the connected rig, the policy's time, T1."""

from collections import Counter
from math import ceil
from statistics import median
from time import perf_counter
from typing import Final

from equipoise.control.controller import Controller, FlangeKinematics
from equipoise.control.policy import tick_policy
from equipoise.errors import InputError
from equipoise.model.worlds import read_world
from equipoise.outcomes import Outcome
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
from equipoise.rig.simulate import simulate_run
from equipoise.safety.rules import T1_SPEED

T1_TRIALS: Final = 20
"""Number of trials on the twin before a run in T1."""
T1_DURATION: Final = 20.0
"""Length of each of these trials [s]."""
T1_SHARE: Final = 0.9
"""Minimum share of these trials that last [-]."""


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


def rehearse_t1(
    request: RunRequest, *, trials: int = T1_TRIALS, duration: float = T1_DURATION
) -> None:
    """Run trials of a policy on the twin under the speed limit of T1, before a run on a robot.

    Args:
        request: The run.
        trials: Number of trials.
        duration: Length of each [s].

    Raises:
        InputError: The policy does not fit the rig, or too few trials last.
    """
    check_request(request)
    nominal = read_world("twin:nominal")
    in_t1 = nominal.settings.model_copy(
        update={"t1": True, "counts_per_rev": request.settings.counts_per_rev}
    )
    ended = Counter[Outcome]()
    for seed in range(trials):
        run = simulate_run(
            request.policy,
            world=nominal._replace(settings=in_t1),
            actuator=None if request.alternatives else request.actuator,
            seed=seed,
            duration=duration,
        )
        ended[run.outcome] += 1
    least = ceil(T1_SHARE * trials)
    if ended[Outcome.LASTED] < least:
        others = ", ".join(f"{each} {n}" for each, n in ended.items() if each != Outcome.LASTED)
        raise InputError(
            f"on the twin in T1 this policy lasts {duration:g} s in {ended[Outcome.LASTED]} of "
            f"{trials} trials, expected {least} (ended by: {others}); train one for "
            f"this limit: equipoise train --set plant.max_speed={T1_SPEED:g}"
        )
