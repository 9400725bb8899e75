"""Measurements and checks before the arm moves, for the pre-flight of a run and the diagnosis.

The loop of the measurements is measured, too: a late loop finds every device late.
"""

from collections.abc import Generator
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from equipoise.arrays import Array
from equipoise.control.controller import Controller, FlangeKinematics
from equipoise.control.policy import shipped_policy, tick_policy
from equipoise.errors import InputError, LinkError
from equipoise.identification.driven_swing import MODEL_STEP, driven_swing
from equipoise.model.pendulum import PendulumParameters
from equipoise.rig.checks import (
    Finding,
    check_deadlines,
    check_encoder,
    check_kernel,
    check_link,
    check_posture,
    check_settings,
    check_speed,
    find,
    max_flange_speed,
)
from equipoise.rig.clocks import DrainingClock, SystemClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import Rig
from equipoise.rig.host import prepare
from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, Robot
from equipoise.rig.request import RunRequest
from equipoise.rig.script import POLICY_TIME_FRACTION
from equipoise.user_code import guest_code


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
    clock = TimedClock(rig.clock)
    waiting = DrainingClock(clock, rig.sensor)
    paced = rig.plugin.paced
    trips = round_trips(rig.robot, waiting, seconds, paced=paced)
    rule = rig.plugin.flange_speed
    max_speed = max_flange_speed(settings.described_arm, trips, request.max_speed, rule)
    results = [
        check_link(trips, paced=paced),
        *check_speed(policy, max_speed),
        check_posture(rig.robot.measured(), settings),
        *check_encoder(settings, *listen(rig.sensor, clock, seconds)),
        *check_settings(granted),
        *([check_kernel(Path("/sys/kernel/realtime").exists())] if paced and granted else []),
    ]
    return [check_deadlines(np.array(clock.late), paced=paced), *results], max_speed


def examine(
    robot: Robot | None,
    sensor: AngleSensor | None,
    rig: RigSettings | None,
    seconds: float,
    *,
    paced: bool = False,
) -> list[Finding]:
    """Measure a machine and a rig, and judge the measurements; no arm moves.

    This thread keeps the real-time settings of a run's loop.

    Args:
        robot: The robot, not connected; None examines none.
        sensor: The encoder, not connected; None examines none.
        rig: Contents of `rig.toml`; None where they are unknown.
        seconds: Duration of each measurement [s].
        paced: Whether the robot sets the pace.
    """
    clock = TimedClock(SystemClock())
    machine, findings = check_settings(prepare()), list[Finding]()
    machine += [check_kernel(Path("/sys/kernel/realtime").exists())] if paced else []
    begin = clock.now()
    for k in range(max(round(seconds / SETPOINT_PERIOD), 1)):
        clock.wait_until(begin + (k + 1) * SETPOINT_PERIOD)
    for device in (sensor, robot):
        if device is None:
            continue
        name = "encoder" if device is sensor else "robot"
        try:
            with guest_code(f"the driver of the {name}"):
                device.connect()
                if isinstance(device, AngleSensor):
                    findings += check_encoder(rig, *listen(device, clock, seconds))
                else:
                    trips = round_trips(device, clock, seconds, paced=paced)
                    findings.append(check_link(trips, paced=paced))
        except LinkError as error:
            remedy = "check its power, its cable and its address"
            findings.append(find(name, str(error), remedy, bad=True))
        finally:
            device.close()
    return [*machine, check_deadlines(np.array(clock.late), paced=paced), *findings]


def warm_up(request: RunRequest) -> None:
    """Run all code of a tick and of the self-test's model, to compile it before the stream starts.

    The policy's part is timed. The policy that an identified arm is compared with is read.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay exceeds the controller's history.
        InputError: The policy raises, returns no finite number, or takes too long.
    """
    settings, policy = request.settings, tick_policy(request.policy)
    arm = settings.described_arm
    params, _ = request.parameters(request.actuator, settings.counts_per_rev)
    controller, took = Controller(arm, params, request.policy.settings.boxes), list[float]()
    policy.reset()
    for _ in range(20):
        controller.observe(0.0, 0.0, arm.home, 0.0)
        began = perf_counter()
        u = controller.decide(policy)
        took.append(perf_counter() - began)
        _ = controller.box  # the log of a tick names it
        controller.command(u)
    controller.hold()  # a tick that was missed
    driven_swing(0.0, 0.0, np.zeros(1), MODEL_STEP, PendulumParameters(1.0, 1.0, 0.0), np.zeros(2))
    FlangeKinematics(arm, params).pose(arm.home)
    if request.identify is not None:
        shipped_policy()  # to read it in a tick takes 50 ms, once all memory is locked
    typical, limit = median(took), POLICY_TIME_FRACTION * request.policy.h
    if typical > limit:
        raise InputError(
            f"{request.policy.name} takes {1e3 * typical:.1f} ms, expected at most "
            f"{1e3 * limit:.1f} ms; make it faster"
        )


class TimedClock:
    """Clock that records how late its waits end."""

    def __init__(self, clock: Clock) -> None:
        """Wrap a clock."""
        self._clock = clock
        self.late: list[float] = []
        """Time from the end of each wait, or from its begin if that was later, to the return [s]:
        a slow device does not count."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait until a time [s]."""
        due = max(time, self.now())
        self._clock.wait_until(time)
        self.late.append(self.now() - due)


def round_trips(robot: Robot, clock: Clock, seconds: float, *, paced: bool = False) -> Array:
    """Measure how long a connected robot at rest takes to return its joints [s], shape (n,).

    It is asked once per setpoint, where its reply has arrived by then; a robot that sets the pace
    for each of its states.

    Args:
        robot: The robot; it does not move.
        clock: The rig's clock.
        seconds: Length of the measurement [s]; at least one round trip is measured.
        paced: Whether the robot sets the pace.

    Raises:
        LinkError: The robot does not answer.
    """
    robot.measured()
    trips: list[float] = []
    begin, period = clock.now(), 0.001 if paced else SETPOINT_PERIOD
    for k in range(max(round(seconds / period), 1)):
        clock.wait_until(begin + k * period)
        asked = clock.now()
        if k and asked - begin >= seconds:
            break
        robot.measured()
        trips.append(clock.now() - asked)
    return np.array(trips)


def listen(
    sensor: AngleSensor, clock: Clock, seconds: float
) -> tuple[int, float, Array, float, int]:
    """Measure the stream of a connected encoder; return the arguments of `check_encoder`.

    Args:
        sensor: The encoder.
        clock: The rig's clock.
        seconds: Length of the measurement [s].

    Raises:
        LinkError: The encoder is disconnected or silent.
    """
    for _ in _reads(clock, 0.1):
        sensor.samples()
    before, begin = sensor.rejected, clock.now()
    newest, received, missing, illegal = begin, 0, 0, 0
    ages: list[float] = []
    for _ in _reads(clock, seconds):
        samples, now = sensor.samples(), clock.now()
        for sample in samples:
            missing, illegal = missing + sample.missing, illegal + sample.illegal
            newest = sample.time
        received += len(samples)
        ages.append(now - newest)
    lost = missing + sensor.rejected - before
    rate = received / (clock.now() - begin)
    share = lost / max(received + lost, 1)
    return sensor.counts_per_rev, rate, np.array(ages), share, illegal


def _reads(clock: Clock, seconds: float) -> Generator[None]:
    """Yield once per read period."""
    begin = deadline = clock.now()
    while (now := clock.now()) < begin + seconds:
        deadline = max(deadline + 0.001, now)
        clock.wait_until(deadline)
        yield
