"""A rig: which arm stands where with which pendulum holder and encoder, and how to reach it.

`rig.toml` says it once, in the units of a tape measure and a protractor; every field has a default,
unknown ones are refused::

    arm = "iiwa7"
    robot = "kst://172.31.1.147:30001"
    encoder = "serial:///dev/ttyACM0"
    counts_per_rev = 8192
    encoder_sign = -1
    media_flange_mm = 35

`connect` is the only place that picks a device.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, partial
from math import degrees, hypot, radians
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from pydantic import Field, ValidationError

from equipoise.artefacts import Name, Value, first_fault, value_digest
from equipoise.control.safety import POSITION_MARGIN, TORQUE_SHARE
from equipoise.devices.clocks import SystemClock, VirtualClock
from equipoise.devices.encoder.board import Board
from equipoise.devices.encoder.sensor import LineEncoder
from equipoise.devices.encoder.serial_port import check_serial, open_serial
from equipoise.devices.interfaces import AngleSensor, Clock, Robot
from equipoise.devices.kuka.codec import PORT
from equipoise.devices.kuka.robot import KstRobot, dial
from equipoise.devices.kuka.server_emulator import KstServer
from equipoise.devices.operator import Operator
from equipoise.devices.transports import MemoryPipe, memory_pipe
from equipoise.devices.twin.emulated_operator import EmulatedOperator
from equipoise.devices.twin.robot import TwinEncoder, TwinRobot
from equipoise.devices.twin.simulated_rig import SimulatedRig
from equipoise.errors import ArmError, InputError, LinkError, SettingsError
from equipoise.model.arms.arm import FREE_JOINTS, MOST_JOINTS, Arm
from equipoise.model.arms.chain import Triple
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.resolve import SUFFIXES, placed, resolve_arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.sim_configs import PREFIX as TWIN
from equipoise.model.sim_configs import World, pendulum_on, read_world
from equipoise.settings import read_toml

Degrees = Annotated[float, Field(ge=-180.0, le=180.0)]
Millimetres = Annotated[float, Field(ge=-1e3, le=1e3)]

LARGEST_TILT_DEG: Final = 1.0
"""A base that leans more than this is to be levelled [deg]: the track would climb, and gravity
would pull along it by 0.17 m/s^2, a twelfth of the largest command."""
ENCODER_POLL_PERIOD: Final = 0.010
"""So often whoever waits reads the encoder [s]: a terminal keeps 0.1 s of its lines."""
START_OFFSET: Final = 0.1
"""An emulated arm stands up to so far from home at first, each joint [rad]."""


class RigSettings(Value):
    """What `rig.toml` says."""

    name: Name = "rig"
    """What the rig is called in logs."""
    arm: Name = "iiwa7"
    """Name of the arm, or path of its URDF (from the folder of this file)."""
    held: int | Name | None = None
    """Joint of a URDF that does not move, by name or counted from one."""
    base: Name | None = None
    """Fixed link of a URDF; by default its root."""
    tip: Name | None = None
    """Link of a URDF that is the flange; by default its only end."""
    acceleration_deg: float | None = Field(default=None, gt=0.0, le=1e5)
    """Acceleration limit of every joint of a URDF [deg/s^2]; a URDF holds none."""
    robot: Name | None = None
    """Where the robot answers, if --robot is not given, e.g. kst://172.31.1.147:30001."""
    encoder: Name | None = None
    """Where the encoder does, if --encoder is not given, e.g. serial:///dev/ttyACM0."""
    home_deg: Annotated[tuple[Degrees, ...], Field(max_length=MOST_JOINTS)] | None = None
    """Posture at x = 0, all joints [deg], with the pendulum's spindle along base y; by default the
    arm's own. For a URDF one is searched, which knows nothing of tables and walls."""
    pivot_mm: tuple[Millimetres, Millimetres, Millimetres] | None = None
    """Pivot of the pendulum in the flange frame [mm]; by default the arm's own."""
    pivot_outward_mm: float | None = Field(default=None, ge=0.0, le=500.0)
    """Distance from the axis of an iiwa's A7 to the plane in which the pendulum turns [mm]."""
    media_flange_mm: Literal[0, 35, 61] = 0
    """Height of an iiwa's media flange: none, electric or pneumatic, touch pneumatic [mm]."""
    counts_per_rev: int = Field(default=8192, ge=64, le=2**24)
    """Encoder counts per revolution, after x4."""
    encoder_sign: Literal[1, -1] = 1
    """1 if counts grow with theta, the pendulum's angle from hanging, else -1."""
    table_height_mm: float | None = Field(default=None, ge=-2e3, le=2e3)
    """The highest thing below the track, above the plane of the arm's base [mm]; none if there is
    nothing. The hanging pendulum must not come near it."""
    base_tilt_deg: tuple[Degrees, Degrees] = (0.0, 0.0)
    """How the base leans, about its x and its y [deg]."""
    position_margin_deg: float = Field(default=degrees(POSITION_MARGIN), ge=1.0, le=30.0)
    """Setpoints stay so far inside the joints' limits [deg]."""
    speed_share: float = Field(default=1.0, gt=0.0, le=1.0)
    """... and below this share of their velocity limits; a run stops before it is passed."""
    torque_share: float = Field(default=TORQUE_SHARE, gt=0.0, le=1.0)
    """Of the torque that a joint can give: a run stops where the external one is further than that
    from what it was at home."""

    @property
    def digest(self) -> str:
        """SHA-256 of all of it."""
        return value_digest(self)

    @cached_property
    def described_arm(self) -> Arm:
        """The arm as it stands there: its home, and the pendulum's pivot on its flange.

        Raises:
            ArmError: There is no such arm, or home is outside the joints' limits.
        """
        limit = self.acceleration_deg
        arm = resolve_arm(
            self.arm,
            held=self.held,
            base=self.base,
            tip=self.tip,
            acceleration=None if limit is None else radians(limit),
            home=None if self.home_deg is None else [radians(angle) for angle in self.home_deg],
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
        own = -arm.pivot[0] if outward is None else outward / 1e3
        return -own, 0.0, self.media_flange_mm / 1e3


def read_rig(path: Path | None) -> RigSettings:
    """Return what a `rig.toml` says; without one, the defaults.

    Raises:
        SettingsError: The file cannot be read, or says what cannot be.
    """
    if path is None:
        return RigSettings()
    tree = read_toml(path, "the rig")
    arm = tree.get("arm")
    if isinstance(arm, str) and Path(arm).suffix.lower() in SUFFIXES:
        tree["arm"] = str(path.parent / arm)
    try:
        rig = RigSettings.model_validate(tree)
    except ValidationError as error:
        fault = first_fault(error)
        known = ", ".join(RigSettings.model_fields)
        what = f"{fault.what}, got {fault.got}"
        if fault.unknown:
            what = f"there is no such setting; known: {known}"
        raise SettingsError(f"the rig {path}: {fault.where}: {what}") from None
    try:
        _ = rig.described_arm
    except ArmError as error:
        raise SettingsError(f"the rig {path}: {error}") from None
    tilt = hypot(*rig.base_tilt_deg)
    if tilt > LARGEST_TILT_DEG:
        raise SettingsError(
            f"the rig {path}: base_tilt_deg is {tilt:.2f} deg in all, expected at most "
            f"{LARGEST_TILT_DEG:g}; level the base"
        )
    return rig


class DrainingClock:
    """A clock for whoever waits before a run: meanwhile nothing piles up at the encoder."""

    def __init__(self, clock: Clock, sensor: AngleSensor) -> None:
        """Attend to a sensor."""
        self._clock, self._sensor = clock, sensor

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait, and drop what the sensor says."""
        until = self._clock.now()
        while until < time:
            until = min(time, until + ENCODER_POLL_PERIOD)
            self._clock.wait_until(until)
            with suppress(LinkError):  # it is not connected yet; or says so again when asked
                self._sensor.samples()


class Rig(NamedTuple):
    """A robot, an angle sensor on the pendulum, and the clock of both."""

    robot: Robot
    """The arm."""
    sensor: AngleSensor
    """The encoder."""
    clock: Clock
    """Their time."""
    operator: Operator | None
    """Who stands at an emulated rig; none where a person does."""

    @property
    def virtual(self) -> bool:
        """Whether time passes only where someone waits."""
        return isinstance(self.clock, VirtualClock)


def is_virtual(robot: str) -> bool:
    """Return whether an address is that of a rig in this process, in virtual time."""
    return robot.startswith(TWIN)


ENCODER_MISSING: Final = "a robot alone does not balance; give --encoder serial:///dev/ttyACM0"


def check_addresses(robot: str, encoder: str | None) -> None:
    """Check that two addresses are those of a rig; nothing is opened.

    Raises:
        InputError: They are not.
        SettingsError: There is no such twin.
    """
    if is_virtual(robot):
        if encoder is not None:
            raise InputError(f"{robot} has an encoder of its own; leave --encoder out")
        read_world(robot)
        return
    _host_and_port(robot)
    if encoder is None:
        raise InputError(ENCODER_MISSING)
    check_serial(encoder)


def _host_and_port(robot: str) -> tuple[str, int]:
    try:
        parts = urlsplit(robot)
    except ValueError:  # a bracket is open
        parts = urlsplit("")
    if parts.scheme != "kst" or not parts.hostname or parts.path.strip("/") or parts.query:
        raise InputError(
            f"{robot!r} is no address of a robot; expected kst://HOST:{PORT} or twin:nominal"
        )
    try:
        parts.hostname.encode("idna")
    except UnicodeError:
        raise InputError(
            f"{robot!r} has an invalid host name; give the name or the number of the cabinet, such "
            "as 172.31.1.147"
        ) from None
    with suppress(ValueError):  # it is no number, or a large one
        port = PORT if parts.port is None else parts.port
        if port > 0:
            return parts.hostname, port
    raise InputError(f"{robot!r} has a port that is none; expected 1 to 65535")


def connect(
    robot: str,
    encoder: str | None,
    settings: RigSettings,
    pendulum: Pendulum,
    *,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
    attend: Callable[[], None] = lambda: None,
) -> Rig:
    """Return the rig behind two addresses; nothing is opened before its parts are connected.

    Args:
        robot: `kst://HOST` or `kst://HOST:PORT`; or `twin:NAME`, a digital twin in this process
            whose time passes as fast as it can, with its own encoder and operator.
        encoder: `serial:///dev/ttyACM0` or `socket://HOST:PORT`; none for a twin.
        settings: What `rig.toml` says.
        pendulum: That hangs on a twin.
        seed: Of what is random on a twin.
        tell: Takes what the operator has to know while a connection is waited for.
        attend: Called now and then meanwhile; what this raises ends the wait.

    Raises:
        InputError: An address is none of these.
        SettingsError: There is no such twin.
    """
    check_addresses(robot, encoder)
    if is_virtual(robot):
        world = read_world(robot)
        return twin_rig(world, settings, pendulum_on(pendulum, world.settings), seed=seed)
    if encoder is None:  # checked above
        raise InputError(ENCODER_MISSING)
    clock = SystemClock()
    sensor = encoder_at(
        encoder,
        clock,
        counts_per_rev=settings.counts_per_rev,
        sign=settings.encoder_sign,
    )
    waiting = DrainingClock(clock, sensor)
    return Rig(robot_at(robot, waiting, tell=tell, attend=attend), sensor, clock, None)


def robot_at(
    robot: str,
    clock: Clock,
    *,
    tell: Callable[[str], None] = lambda _: None,
    attend: Callable[[], None] = lambda: None,
) -> Robot:
    """Return the robot behind an address; nothing is opened before it is connected.

    Args:
        robot: `kst://HOST` or `kst://HOST:PORT`.
        clock: Its time.
        tell: Takes what the operator has to know while a connection is waited for.
        attend: Called now and then meanwhile; what this raises ends the wait.

    Raises:
        InputError: It is no such address.
    """
    return KstRobot(dial(*_host_and_port(robot)), clock, tell=tell, attend=attend)


def encoder_at(
    encoder: str, clock: Clock, *, counts_per_rev: int | None = None, sign: int = 1
) -> AngleSensor:
    """Return the encoder behind an address; nothing is opened before it is connected.

    Args:
        encoder: `serial:///dev/ttyACM0` or `socket://HOST:PORT`.
        clock: Its time.
        counts_per_rev: What is expected of its board, after x4; any number if not given.
        sign: 1 if its counts grow with theta, -1 if they fall.

    Raises:
        InputError: It is no such address.
    """
    check_serial(encoder)
    return LineEncoder(
        partial(open_serial, encoder),
        clock,
        counts_per_rev=counts_per_rev,
        sign=sign,
        name=encoder,
    )


def twin_rig(
    world: World, settings: RigSettings, pendulum: PendulumParameters, *, seed: int = 0
) -> Rig:
    """Return a twin with its operator, robot and encoder in process, in virtual time.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    clock, bench = _bench(world, settings, pendulum, seed)
    operator = EmulatedOperator(bench, clock, seed=seed)
    return Rig(TwinRobot(bench, clock), TwinEncoder(bench, clock), clock, operator)


class EmulatedRig(NamedTuple):
    """A twin behind the protocols of the hardware, and what a test can do to it."""

    rig: Rig
    """The drivers."""
    bench: SimulatedRig
    """Arm, pendulum, hand and button."""
    server: KstServer
    """The robot's cabinet."""
    board: Board
    """The encoder's board."""
    robot_link: MemoryPipe
    """The cabinet's end of the link to the robot."""
    encoder_link: MemoryPipe
    """The board's end of the link to the encoder."""


def emulated_rig(
    world: World, settings: RigSettings, pendulum: PendulumParameters, *, seed: int = 0
) -> EmulatedRig:
    """Return the drivers of the hardware in front of a twin that speaks its bytes, in virtual time.

    The link to the cabinet takes half the twin's reply age each way; the rest of its transport is
    the servo's own.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    delay = 0.5 * world.settings.reply_age
    within = world.settings.model_copy(
        update={"transport": max(world.settings.transport - delay, 0.0)}
    )
    clock, bench = _bench(World(world.name, within), settings, pendulum, seed)
    arm = settings.described_arm
    server = KstServer(bench.body, [joint.velocity for joint in arm.joints], seed=seed)
    board = Board(
        lambda: bench.theta,
        counts_per_rev=world.settings.counts_per_rev,
        sign=settings.encoder_sign,
        seed=seed,
    )
    host, cabinet = memory_pipe(clock, delay)
    reader, wire = memory_pipe(clock, world.settings.encoder_age)
    down = [False]

    def work(now: float) -> None:
        with suppress(LinkError):  # who has closed it is not answered; the servo goes on
            server.feed(cabinet.read(), now)
        for segment in server.advance(now):
            with suppress(LinkError):
                cabinet.write(segment)
        if bench.button is not down[0]:
            down[0] = bench.button
            board.press() if down[0] else board.let_go()
        said = board.advance(now)
        with suppress(LinkError):
            board.feed(wire.read())
            wire.write(said)

    clock.attach(work)
    operator = EmulatedOperator(bench, clock, seed=seed)
    sensor = LineEncoder(
        lambda: reader,
        clock,
        counts_per_rev=settings.counts_per_rev,
        sign=settings.encoder_sign,
    )
    robot = KstRobot(lambda: host, DrainingClock(clock, sensor))
    return EmulatedRig(Rig(robot, sensor, clock, operator), bench, server, board, cabinet, wire)


def _bench(
    world: World, settings: RigSettings, pendulum: PendulumParameters, seed: int
) -> tuple[VirtualClock, SimulatedRig]:
    if world.settings.counts_per_rev != settings.counts_per_rev:
        raise SettingsError(
            f"{world.name} has {world.settings.counts_per_rev} counts per revolution, rig.toml "
            f"{settings.counts_per_rev}; give one number"
        )
    clock = VirtualClock()
    arm = settings.described_arm
    elsewhere = arm.home_free + START_OFFSET * np.random.default_rng(seed).uniform(
        -1.0, 1.0, FREE_JOINTS
    )
    bench = SimulatedRig(arm, pendulum, world.settings, seed=seed, q=elsewhere)
    clock.attach(bench.advance)
    return clock, bench
