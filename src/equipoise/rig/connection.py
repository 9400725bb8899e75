"""Connection of a rig: the drivers behind addresses, or drivers in front of emulators on a twin.

No other module opens devices. The plugin for the scheme of an address makes its driver
(`equipoise.rig.plugins`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from equipoise.errors import InputError, SettingsError
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import World, pendulum_on, read_world
from equipoise.rig.clocks import DrainingClock, SystemClock, VirtualClock
from equipoise.rig.config import Load, RigSettings, world_of
from equipoise.rig.interfaces import (
    SETPOINT_PERIOD,
    AngleSensor,
    Clock,
    Operator,
    PacedRobot,
    Robot,
)
from equipoise.rig.paced import PacedStream
from equipoise.rig.plugins import (
    Bodies,
    Emulated,
    RobotPlugin,
    SensorPlugin,
    Session,
    ignore,
    make_driver,
    robot_plugin,
    scheme_of,
)
from equipoise.rig.request import RunRequest
from equipoise.rig.simulated_rig import EmulatedOperator


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
    emulated: tuple[Emulated[Any], Emulated[AngleSensor]] | None = None
    """Robot and encoder of an emulated rig: their drivers and emulators, for fault injection."""


def open_robot(
    robot: str,
    clock: Clock,
    *,
    tell: Callable[[str], None] = ignore,
    attend: Callable[[], None] = ignore,
    load: Load | None = None,
) -> Robot | PacedRobot:
    """Return the driver behind an address; nothing is opened before it is connected.

    Args:
        robot: Address of a robot that exists.
        clock: Clock of the robot.
        tell: Receives instructions to the operator while a connection is made.
        attend: Called about once a second meanwhile; its exception ends the wait.
        load: Load on the flange; None if it is unknown.

    Raises:
        InputError: The address is invalid.
    """
    return make_driver(RobotPlugin, "open", robot, robot, Session(clock, tell, attend, load))


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
    session = Session(clock)
    return make_driver(SensorPlugin, "open", encoder, encoder, session, counts_per_rev, sign)


def restart_instruction(robot: str) -> str:
    """Return the instruction to the operator before the next connection to a robot.

    Raises:
        InputError: The address is invalid.
    """
    return robot_plugin(robot).restart


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
        world = read_world(twin)
        pendulum = pendulum_on(request.policy.pendulum, world.settings)
        return emulated_rig(
            world,
            settings,
            pendulum,
            robot=scheme_of(robot),
            seed=request.seed,
            period=period,
        )
    if twin is not None or encoder is None:
        raise InputError(
            f"{robot} with --encoder {encoder} is no rig: a robot needs an encoder such as "
            "serial:///dev/ttyACM0, and a twin has one of its own"
        )
    clock, counts = SystemClock(), settings.counts_per_rev
    sensor = open_encoder(encoder, clock, counts_per_rev=counts, sign=settings.encoder_sign)
    draining = DrainingClock(clock, sensor)
    opened = open_robot(robot, draining, tell=tell, attend=attend, load=settings.load)
    return Rig(*_stream(opened, sensor, clock, draining, period), robot_plugin(robot))


def _stream(
    robot: Robot | PacedRobot,
    sensor: AngleSensor,
    clock: Clock,
    draining: DrainingClock,
    period: float,
) -> tuple[Robot, AngleSensor, Clock]:
    """Return the parts of a rig: a robot that sets the pace is behind a stream, the clock too."""
    if not isinstance(robot, PacedRobot):
        return robot, sensor, clock
    stream = PacedStream(robot, clock, period, draining)
    return stream, sensor, stream


def emulated_rig(
    world: World,
    settings: RigSettings,
    pendulum: PendulumParameters,
    *,
    robot: str,
    seed: int = 0,
    period: float = SETPOINT_PERIOD,
) -> Rig:
    """Return a twin behind the drivers of a kind of robot, in virtual time, with its operator.

    The link of an emulated robot takes its share of the twin's reply age each way, and the servo
    the rest of the twin's transport. A robot whose plugin makes a bench of its own has its own link
    and servo, too.

    Args:
        world: The twin.
        settings: The settings of the rig.
        pendulum: The pendulum, with the friction that acts in the twin.
        robot: Scheme of the robot.
        seed: Seed of all random numbers.
        period: Time between two setpoints [s].

    Raises:
        ArmError: The masses of the arm's links are unknown.
        InputError: The robot has no emulator, or its plugin is defective.
        SettingsError: Twin and rig differ in the counts per revolution.
    """
    plugin = robot_plugin(robot)
    numbers = world.settings.model_copy(update=plugin.servo.model_dump(exclude_unset=True))
    if numbers.counts_per_rev != settings.counts_per_rev:
        raise SettingsError(
            f"{world.name} has {numbers.counts_per_rev} counts per revolution, rig.toml "
            f"{settings.counts_per_rev}; give one number"
        )
    delay = plugin.link_share * numbers.reply_age
    numbers = numbers.model_copy(update={"transport": max(numbers.transport - delay, 0.0)})
    clock, arm = VirtualClock(), settings.described_arm
    # The joints begin up to 0.1 rad beside home.
    offset = 0.1 * np.random.default_rng(seed).uniform(-1.0, 1.0, FREE_JOINTS)
    bench = plugin.bench(Bodies(arm, pendulum, numbers, arm.home_free + offset, 0.0, seed))
    clock.attach(bench.advance)
    encoder = bench, clock, settings.counts_per_rev, settings.encoder_sign, seed
    sensor = make_driver(SensorPlugin, "emulate", "serial", *encoder)
    draining = DrainingClock(clock, sensor.device)
    parts = bench, arm, Session(draining, load=settings.load), delay, seed
    emulated = make_driver(RobotPlugin, "emulate", robot, *parts)
    clock.attach(emulated.advance)
    clock.attach(sensor.advance)
    operator = EmulatedOperator(bench, clock, seed=seed)
    stream = _stream(emulated.device, sensor.device, clock, draining, period)
    return Rig(*stream, plugin, operator, bench, (emulated, sensor))
