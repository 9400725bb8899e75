"""Description of a rig (arm, pendulum holder, encoder and their addresses), and its connection.

`rig.toml` contains the description in mm and degrees; every field has a default, unknown fields are
refused::

    arm = "iiwa7"
    robot = "kst://172.31.1.147:30001"
    encoder = "serial:///dev/ttyACM0"
    counts_per_rev = 8192
    encoder_sign = -1
    media_flange_mm = 35

No other module opens devices: `connect`, `robot_at` and `encoder_at` find the plugin for the scheme
of an address in the registry (`equipoise.rig.plugins`).
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from math import degrees, hypot, radians
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationError

from equipoise.artefacts import Name, Value, first_fault, value_digest
from equipoise.errors import ArmError, InputError, LinkError, SettingsError
from equipoise.model.arms.arm import FREE_JOINTS, MOST_JOINTS, Arm
from equipoise.model.arms.chain import Triple
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.resolve import SUFFIXES, placed, resolve_arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.worlds import PREFIX as TWIN
from equipoise.model.worlds import World, pendulum_on, read_world
from equipoise.rig import plugins
from equipoise.rig.clocks import SystemClock, VirtualClock
from equipoise.rig.emulated_operator import EmulatedOperator
from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, PacedRobot, Robot
from equipoise.rig.operator import Operator
from equipoise.rig.paced import PacedStream
from equipoise.rig.plugins import Session, ignore, robot_plugin, scheme_of, sensor_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.safety.rules import POSITION_MARGIN, TORQUE_SHARE
from equipoise.settings import read_toml

Degrees = Annotated[float, Field(ge=-180.0, le=180.0)]
Millimetres = Annotated[float, Field(ge=-1e3, le=1e3)]

MAX_TILT_DEG: Final = 1.0
"""Maximum tilt of the base [deg]: along a track with this slope gravity pulls by 0.17 m/s^2, a
twelfth of the largest command."""
ENCODER_POLL_PERIOD: Final = 0.010
"""Encoder polling period while waiting [s]; a terminal buffers 0.1 s of lines."""
START_OFFSET: Final = 0.1
"""Maximum initial distance of each emulated joint from home [rad]."""


class RigSettings(Value):
    """Contents of `rig.toml`."""

    name: Name = "rig"
    """Name of the rig in logs."""
    arm: Name = "iiwa7"
    """Name of the arm, or path of its URDF (from the folder of this file)."""
    held: int | Name | None = None
    """Joint of a URDF that is held still, by name or counted from one."""
    base: Name | None = None
    """Fixed link of a URDF; by default its root."""
    tip: Name | None = None
    """Link of a URDF that is the flange; by default its only end."""
    acceleration_deg: float | None = Field(default=None, gt=0.0, le=1e5)
    """Acceleration limit of every joint of a URDF [deg/s^2], which a URDF does not contain."""
    robot: Name | None = None
    """Default of --robot, e.g. kst://172.31.1.147:30001."""
    encoder: Name | None = None
    """Default of --encoder, e.g. serial:///dev/ttyACM0."""
    home_deg: Annotated[tuple[Degrees, ...], Field(max_length=MOST_JOINTS)] | None = None
    """Posture at x = 0, all joints [deg], with the pendulum's spindle along base y; by default the
    arm's own. For a URDF a posture is searched, without regard to tables and walls."""
    pivot_mm: tuple[Millimetres, Millimetres, Millimetres] | None = None
    """Pivot of the pendulum in the flange frame [mm]; by default the arm's own."""
    pivot_outward_mm: float | None = Field(default=None, ge=0.0, le=500.0)
    """Distance from the axis of an iiwa's A7 to the plane in which the pendulum turns [mm]."""
    media_flange_mm: Literal[0, 35, 61] = 0
    """Height of an iiwa's media flange: none, electric or pneumatic, touch pneumatic [mm]."""
    pendulum_mass_kg: float | None = Field(default=None, ge=1e-3, le=14.0)
    """Mass of the pendulum [kg], weighed; with the bracket's, the inertia of A7's drive can be
    identified."""
    bracket_mass_kg: float | None = Field(default=None, ge=0.0, le=14.0)
    """Mass of bracket and encoder from the flange to the pivot [kg], weighed."""
    counts_per_rev: int = Field(default=8192, ge=64, le=2**24)
    """Encoder counts per revolution, after x4."""
    encoder_sign: Literal[1, -1] = 1
    """1 if counts grow with theta, the pendulum's angle from hanging, else -1."""
    table_height_mm: float | None = Field(default=None, ge=-2e3, le=2e3)
    """Height of the highest obstacle below the track, above the plane of the arm's base [mm]; None
    without an obstacle. The hanging pendulum must keep clear of it."""
    base_tilt_deg: tuple[Degrees, Degrees] = (0.0, 0.0)
    """Tilt of the base about its x and its y [deg]."""
    position_margin_deg: float = Field(default=degrees(POSITION_MARGIN), ge=1.0, le=30.0)
    """Minimum distance of setpoints from the joints' position limits [deg]."""
    speed_share: float = Field(default=1.0, gt=0.0, le=1.0)
    """Maximum share of the joints' velocity limits [-]; a run stops before exceeding it."""
    torque_share: float = Field(default=TORQUE_SHARE, gt=0.0, le=1.0)
    """Maximum change of an external torque from its value at home, as a share of the joint's torque
    limit [-]; a run stops beyond it."""

    @property
    def digest(self) -> str:
        """SHA-256 of all fields."""
        return value_digest(self)

    def changed(self, **fields: Any) -> Self:
        """Return a rig with some fields changed; unlike `model_copy`, it rebuilds the arm."""
        return self.model_validate(self.model_dump() | fields)

    @cached_property
    def described_arm(self) -> Arm:
        """Arm of the rig, with its home posture and the pendulum's pivot on its flange.

        Raises:
            ArmError: The arm is unknown, or home is outside the joints' limits.
        """
        limit = None if self.acceleration_deg is None else radians(self.acceleration_deg)
        home = None if self.home_deg is None else [radians(angle) for angle in self.home_deg]
        arm = resolve_arm(
            self.arm, held=self.held, base=self.base, tip=self.tip, acceleration=limit, home=home
        )
        return placed(arm, home=None, pivot=self._pivot(arm))

    def _pivot(self, arm: Arm) -> Triple | None:
        """Return the pivot in the flange frame [m]; `None` for the arm's own."""
        of_iiwa = self.pivot_outward_mm is not None or self.media_flange_mm
        if of_iiwa and self.pivot_mm is not None:
            raise ArmError(
                "pivot_mm places the pivot, and so do pivot_outward_mm and media_flange_mm; give "
                "pivot_mm alone"
            )
        if of_iiwa and arm.digest not in (iiwa(7).digest, iiwa(14).digest):
            raise ArmError(
                "pivot_outward_mm and media_flange_mm place the pivot of an iiwa, and this is "
                f"{arm.name}; give pivot_mm"
            )
        if self.pivot_mm is not None:
            x, y, z = self.pivot_mm
            return x / 1e3, y / 1e3, z / 1e3
        if not of_iiwa:
            return None
        outward = self.pivot_outward_mm
        x = arm.pivot[0] if outward is None else -outward / 1e3
        return x, 0.0, self.media_flange_mm / 1e3


def read_rig(path: Path | None) -> RigSettings:
    """Read a `rig.toml`; return the defaults without a path.

    Raises:
        SettingsError: The file cannot be read, or a value is invalid.
    """
    if path is None:
        return RigSettings()
    tree = read_toml(path, "the rig")
    arm = tree.get("arm")
    if isinstance(arm, str) and Path(arm).suffix.lower() in SUFFIXES:
        tree["arm"] = str(path.parent / arm)
    try:
        rig = RigSettings.model_validate(tree)
        _ = rig.described_arm
    except ValidationError as error:
        fault = first_fault(error)
        what = f"{fault.what}, got {fault.got}"
        if fault.unknown:
            what = f"there is no such setting; known: {', '.join(RigSettings.model_fields)}"
        raise SettingsError(f"the rig {path}: {fault.where}: {what}") from None
    except ArmError as error:
        raise SettingsError(f"the rig {path}: {error}") from None
    tilt = hypot(*rig.base_tilt_deg)
    if tilt > MAX_TILT_DEG:
        raise SettingsError(
            f"the rig {path}: base_tilt_deg is {tilt:.2f} deg in all, expected at most "
            f"{MAX_TILT_DEG:g}; level the base"
        )
    return rig


class DrainingClock:
    """Clock for waits before a run; the encoder's samples are dropped meanwhile."""

    def __init__(self, clock: Clock, sensor: AngleSensor) -> None:
        """Wrap a clock, and drain a sensor."""
        self._clock, self._sensor, self._drains = clock, sensor, True

    def keep(self, streaming: bool) -> None:
        """Keep the samples while a robot that sets the pace waits in the stream."""
        self._drains = not streaming

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait until a time [s], and drop the samples that come meanwhile."""
        until = self._clock.now()
        while until < time:
            until = min(time, until + ENCODER_POLL_PERIOD)
            self._clock.wait_until(until)
            with suppress(LinkError):  # not connected yet; or the next reader gets the error again
                if self._drains:
                    self._sensor.samples()


class Rig(NamedTuple):
    """A robot, an angle sensor on the pendulum, and the clock of both."""

    robot: Robot
    """The arm."""
    sensor: AngleSensor
    """The encoder."""
    clock: Clock
    """Clock of both."""
    operator: Operator | None
    """Emulated operator; None for a person at the rig."""
    plugin: plugins.RobotPlugin
    """The kind of robot."""


def world_of(robot: str) -> str | None:
    """Return the twin behind an address; None for hardware.

    Example:
        >>> world_of("twin:nominal"), world_of("kst://twin:harsh"), world_of("kst://172.31.1.147")
        ('twin:nominal', 'twin:harsh', None)
    """
    name = robot.partition("://")[2] or robot
    return name if name.startswith(TWIN) else None


def is_virtual(robot: str) -> bool:
    """Return whether an address is that of a rig in this process, in virtual time."""
    return world_of(robot) is not None


ENCODER_MISSING: Final = "a robot alone does not balance; give --encoder serial:///dev/ttyACM0"


def check_addresses(robot: str, encoder: str | None) -> None:
    """Check the two addresses of a rig; nothing is opened.

    Raises:
        InputError: An address is invalid, missing or superfluous.
        SettingsError: The twin is unknown.
    """
    plugin, world = robot_plugin(robot), world_of(robot)
    if world is not None:
        if encoder is not None:
            raise InputError(f"{robot} has an encoder of its own; leave --encoder out")
        if plugin.emulate is None:
            raise InputError(f"{robot}: the robot has no emulator; expected {plugin.form}")
        read_world(world)
        return
    plugin.check(robot)
    if encoder is None:
        raise InputError(ENCODER_MISSING)
    sensor_plugin(encoder).check(encoder)


def connect(
    robot: str,
    encoder: str | None,
    settings: RigSettings,
    pendulum: Pendulum,
    *,
    seed: int = 0,
    period: float = SETPOINT_PERIOD,
    tell: Callable[[str], None] = ignore,
    attend: Callable[[], None] = ignore,
) -> Rig:
    """Return the rig behind two addresses; nothing is opened before its parts are connected.

    Args:
        robot: Address of a robot, such as `kst://HOST`; or `twin:NAME`, a digital twin in this
            process in virtual time, with its own encoder and operator; or
            `SCHEME://twin:NAME`, the same with the driver and the emulator of a kind of robot.
        encoder: Address of an angle sensor, such as `serial:///dev/ttyACM0`; None for a twin.
        settings: The settings of the rig.
        pendulum: The pendulum on a twin.
        seed: Seed of all random numbers on a twin.
        period: Time between two setpoints [s].
        tell: Receives instructions to the operator while a connection is made.
        attend: Called about once a second meanwhile; its exception ends the wait.

    Raises:
        InputError: An address is invalid.
        SettingsError: The twin is unknown.
    """
    check_addresses(robot, encoder)
    if name := world_of(robot):
        world = read_world(name)
        swinging = pendulum_on(pendulum, world.settings)
        return emulated_rig(
            world, settings, swinging, robot=scheme_of(robot), seed=seed, period=period
        ).rig
    if encoder is None:  # checked above
        raise InputError(ENCODER_MISSING)
    clock = SystemClock()
    sensor = encoder_at(
        encoder, clock, counts_per_rev=settings.counts_per_rev, sign=settings.encoder_sign
    )
    draining = DrainingClock(clock, sensor)
    opened = _opened(robot, Session(draining, tell, attend))
    served, clock = _served(opened, clock, period, draining)
    return Rig(served, sensor, clock, None, robot_plugin(robot))


def _served(
    robot: Robot | PacedRobot, clock: Clock, period: float, draining: DrainingClock
) -> tuple[Robot, Clock]:
    """Return a robot and the clock of its rig, which serves a robot that sets the pace."""
    if not isinstance(robot, PacedRobot):
        return robot, clock
    stream = PacedStream(robot, clock, period, draining.keep)
    return stream, stream


def _opened(robot: str, session: Session) -> Robot | PacedRobot:
    plugin = robot_plugin(robot)
    plugin.check(robot)
    if plugin.open is None:
        raise InputError(f"{robot} exists in virtual time only; give a robot such as kst://HOST")
    return plugin.open(robot, session)


def robot_at(robot: str, clock: Clock, *, tell: Callable[[str], None] = ignore) -> Robot:
    """Return the robot behind an address; nothing is opened before it is connected.

    Args:
        robot: Address of a robot that exists.
        clock: Clock of the robot.
        tell: Receives instructions to the operator while a connection is made.

    Raises:
        InputError: The address is invalid.
    """
    opened = _opened(robot, Session(clock, tell))
    return PacedStream(opened, clock) if isinstance(opened, PacedRobot) else opened


def restart_instruction(robot: str) -> str:
    """Return the instruction to the operator before the next connection to a robot.

    Raises:
        InputError: The address is invalid.
    """
    return robot_plugin(robot).restart


def encoder_at(
    encoder: str, clock: Clock, *, counts_per_rev: int | None = None, sign: int = 1
) -> AngleSensor:
    """Return the angle sensor behind an address; nothing is opened before it is connected.

    Args:
        encoder: Address of a sensor that exists.
        clock: Clock of the rig.
        counts_per_rev: Expected counts per revolution, after x4; None accepts any number.
        sign: 1 if its counts grow with theta, -1 if they fall.

    Raises:
        InputError: The address is invalid.
    """
    plugin = sensor_plugin(encoder)
    plugin.check(encoder)
    if plugin.open is None:
        raise InputError(f"{encoder} exists in virtual time only; give one such as /dev/ttyACM0")
    return plugin.open(encoder, Session(clock), counts_per_rev, sign)


class EmulatedRig(NamedTuple):
    """A simulated rig behind drivers, in virtual time, with access for fault injection."""

    rig: Rig
    """The drivers."""
    bench: SimulatedRig
    """Arm, pendulum, hand and button."""
    robot: plugins.EmulatedRobot
    """The robot's driver, and its emulator."""
    sensor: plugins.EmulatedSensor
    """The encoder's driver, and its emulator."""


def emulated_rig(
    world: World,
    settings: RigSettings,
    pendulum: PendulumParameters,
    *,
    robot: str = "twin",
    seed: int = 0,
    period: float = SETPOINT_PERIOD,
) -> EmulatedRig:
    """Return a twin behind the drivers of a kind of robot, in virtual time, with its operator.

    The link of an emulated robot takes its share of the twin's reply age each way, and the servo
    the rest of the twin's transport.

    Args:
        world: The twin.
        settings: The settings of the rig.
        pendulum: The pendulum, with the friction that acts in the twin.
        robot: Scheme of the robot; `twin` has no link, and the twin's own encoder.
        seed: Seed of all random numbers.
        period: Time between two setpoints [s].

    Raises:
        ArmError: The masses of the arm's links are unknown.
        InputError: The robot has no emulator.
        SettingsError: Twin and rig differ in the counts per revolution.
    """
    plugin = robot_plugin(robot)
    sensors = sensor_plugin(TWIN if robot == scheme_of(TWIN) else "serial")
    if plugin.emulate is None or sensors.emulate is None:
        raise InputError(f"the robot {robot!r} has no emulator; choose another")
    numbers = world.settings.model_copy(update=dict(plugin.servo))
    if numbers.counts_per_rev != settings.counts_per_rev:
        raise SettingsError(
            f"{world.name} has {numbers.counts_per_rev} counts per revolution, rig.toml "
            f"{settings.counts_per_rev}; give one number"
        )
    delay = plugin.link_share * numbers.reply_age
    numbers = numbers.model_copy(update={"transport": max(numbers.transport - delay, 0.0)})
    clock, arm = VirtualClock(), settings.described_arm
    offset = START_OFFSET * np.random.default_rng(seed).uniform(-1.0, 1.0, FREE_JOINTS)
    bench = SimulatedRig(arm, pendulum, numbers, seed=seed, q=arm.home_free + offset)
    clock.attach(bench.advance)
    sensor = sensors.emulate(bench, clock, settings.counts_per_rev, settings.encoder_sign, seed)
    draining = DrainingClock(clock, sensor.sensor)
    # Without a link waits are short, so that no samples have to be dropped.
    session = Session(draining if plugin.link_share else clock)
    emulated = plugin.emulate(bench, arm, session, delay, seed)
    clock.attach(emulated.advance)
    clock.attach(sensor.advance)
    operator = EmulatedOperator(bench, clock, seed=seed)
    served = _served(emulated.robot, clock, period, draining)
    rig = Rig(served[0], sensor.sensor, served[1], operator, plugin)
    return EmulatedRig(rig, bench, emulated, sensor)
