"""Connection of a rig: the drivers behind addresses, or drivers in front of emulators on a twin.

No other module opens devices. The plugin for the scheme of an address makes its driver
(`equipoise.rig.plugins`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from equipoise.arm.arm import FREE_JOINTS
from equipoise.errors import InputError, SettingsError
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.clocks import DrainingClock, SystemClock, VirtualClock
from equipoise.rig.config import RigSettings, world_of
from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, Operator, Robot
from equipoise.rig.plugins import (
    Emulated,
    RobotPlugin,
    Session,
    ignore,
    robot_plugin,
    scheme_of,
    sensor_plugin,
)
from equipoise.rig.request import RunRequest
from equipoise.rig.simulated_rig import Bodies, EmulatedOperator


class Rig(NamedTuple):
    """A robot, an angle sensor on the pendulum, and the clock of both."""

    robot: Robot
    """The arm."""
    sensor: AngleSensor
    """The encoder."""
    clock: Clock
    """Clock of both."""
    plugin: RobotPlugin
    """The kind of robot."""
    operator: Operator | None = None
    """Emulated operator; None for a person at the rig."""
    bench: Any = None
    """Arm, pendulum, hand and button of an emulated rig."""
    emulated: tuple[Emulated, Emulated] | None = None
    """Robot and encoder of an emulated rig: their drivers and emulators, for fault injection."""


def open_encoder(
    encoder: str, clock: Clock, *, counts_per_rev: int | None = None, sign: int = 1
) -> AngleSensor:
    """Return the driver behind an address; nothing is opened before it is connected.

    Args:
        encoder: Address of a sensor that exists.
        clock: Clock of the rig.
        counts_per_rev: Expected counts per revolution, after x4; None accepts any number.
        sign: 1 if its counts grow with theta, -1 if they fall.

    Raises:
        InputError: The address is invalid.
    """
    return sensor_plugin(encoder).open(encoder, Session(clock, clock), counts_per_rev, sign)


def connect(
    request: RunRequest,
    *,
    tell: Callable[[str], None] = ignore,
    attend: Callable[[], None] = ignore,
) -> Rig:
    """Return the rig of a request; nothing is opened before its parts are connected.

    The robot's address is such as `kst://HOST`; or `twin:NAME`, a digital twin in this process in
    virtual time, with its own encoder and operator; or `SCHEME://twin:NAME`, the same with the
    driver and the emulator of a kind of robot.

    Args:
        request: The run.
        tell: Receives instructions to the operator while a connection is made.
        attend: Called about once a second meanwhile; its exception ends the wait.

    Raises:
        InputError: An address is invalid, missing or superfluous.
        SettingsError: The twin is unknown.
    """
    robot, encoder, settings = request.robot, request.encoder, request.settings
    twin, period = world_of(robot), request.policy.h / 2.0
    if twin is not None and encoder is None:
        pendulum, scheme = request.policy.pendulum, scheme_of(robot)
        return emulated_rig(
            twin, settings, pendulum, robot=scheme, seed=request.seed, period=period
        )
    if twin is not None or encoder is None:
        raise InputError(
            f"{robot} with --encoder {encoder} is no rig: a robot needs an encoder such as "
            "serial:///dev/ttyACM0, and a twin has one of its own"
        )
    clock, plugin = SystemClock(), robot_plugin(robot)
    sensor = open_encoder(
        encoder, clock, counts_per_rev=settings.counts_per_rev, sign=settings.encoder_sign
    )
    driving = DrainingClock(clock, sensor)
    driver = plugin.open(robot, Session(driving, clock, period, tell, attend, settings.load))
    return Rig(driver, sensor, cast("Clock", driver) if plugin.paced else clock, plugin)


def emulated_rig(
    twin: str,
    settings: RigSettings,
    pendulum: Pendulum,
    *,
    robot: str,
    seed: int = 0,
    period: float = SETPOINT_PERIOD,
) -> Rig:
    """Return a twin behind the drivers of a kind of robot, in virtual time, with its operator.

    The link of an emulated robot takes half of the twin's reply age each way, and the servo the
    rest of the twin's transport. A robot whose plugin makes a bench of its own has its own link
    and servo, too.

    Args:
        twin: Name of the twin.
        settings: The settings of the rig.
        pendulum: The pendulum.
        robot: Scheme of the robot.
        seed: Seed of all random numbers.
        period: Time between two setpoints [s].

    Raises:
        ArmError: The masses of the arm's links are unknown.
        InputError: The robot has no emulator.
        SettingsError: The twin is unknown, or twin and rig differ in the counts per revolution.
    """
    world, plugin = read_world(twin), robot_plugin(robot)
    numbers = world.settings.model_copy(update=plugin.servo.model_dump(exclude_unset=True))
    if numbers.counts_per_rev != settings.counts_per_rev:
        raise SettingsError(
            f"{world.name} has {numbers.counts_per_rev} counts per revolution, rig.toml "
            f"{settings.counts_per_rev}; give one number"
        )
    delay = 0.5 * numbers.reply_age
    numbers = numbers.model_copy(update={"transport": max(numbers.transport - delay, 0.0)})
    clock, arm = VirtualClock(), settings.described_arm
    # The joints begin up to 0.1 rad beside home.
    offset = 0.1 * np.random.default_rng(seed).uniform(-1.0, 1.0, FREE_JOINTS)
    q, swings = arm.home_free + offset, pendulum_on(pendulum, world.settings)
    bench = plugin.bench(Bodies(arm, swings, numbers, q, 0.0, seed))
    clock.attach(bench.advance)
    sensor = sensor_plugin(settings.encoder or "serial").emulate(
        bench, clock, settings.counts_per_rev, settings.encoder_sign
    )
    session = Session(DrainingClock(clock, sensor.device), clock, period, load=settings.load)
    emulated = plugin.emulate(bench, session, delay)
    clock.attach(emulated.advance)
    clock.attach(sensor.advance)
    return Rig(
        emulated.device,
        sensor.device,
        emulated.device if plugin.paced else clock,
        plugin,
        EmulatedOperator(bench, clock, seed=seed),
        bench,
        (emulated, sensor),
    )
