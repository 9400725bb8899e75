"""Plugins of robots and angle sensors, by the scheme of their addresses.

A package brings a robot in one file. Its `pyproject.toml` names the plugin; the name of the entry
point is the scheme of the addresses::

    [project.entry-points."equipoise.robots"]
    acme = "acme_robot:PLUGIN"

After its installation, `equipoise deploy --robot acme://HOST` opens that robot, and
`--robot acme://twin:nominal` runs its driver against its emulator on a digital twin, in virtual
time. Sensors register under `equipoise.sensors`. The robots and sensors of this package register
in the same way. `equipoise.rig.connection` is the only module that opens devices.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from equipoise.arm.arm import Arm
from equipoise.entry_points import how_to_install, registered
from equipoise.errors import InputError
from equipoise.files import Value
from equipoise.model.worlds import TwinSettings
from equipoise.rig.config import Load
from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, Robot
from equipoise.rig.simulated_rig import Bench, Bodies, SimulatedRig

Plugin = TypeVar("Plugin")


def ignore(*_: object) -> None:
    """Do nothing; the default of optional callbacks."""


class Session(NamedTuple):
    """Environment of a driver: its clocks, and ways to reach the operator while it connects."""

    clock: Clock
    """Clock of the driver, which waits with its `wait_until` only, never with `time.sleep`. Samples
    of the encoder that come meanwhile are dropped."""
    loop_clock: Clock
    """Clock of the loop, for waits of a robot that sets the pace while setpoints stream: it keeps
    the samples."""
    period: float = SETPOINT_PERIOD
    """Time between two setpoints [s]."""
    notify: Callable[[str], None] = ignore
    """Shows the operator an instruction, for example to start the robot's program."""
    attend: Callable[[], None] = ignore
    """To be called about once a second while `connect` waits for the operator. An exception that
    it raises ends the wait."""
    load: Load | None = None
    """Load on the flange, for a robot that needs it from this computer; None if it is unknown."""


class Emulated(NamedTuple):
    """A driver in front of an emulated device, in virtual time."""

    device: Any
    """The driver, a `Robot` or an `AngleSensor`, not yet connected."""
    advance: Callable[[float], None] = ignore
    """Advances the emulator to a time [s]; called each millisecond, after the arm has moved."""
    emulator: Any = None
    """The emulator, for tests that inject faults."""
    link: Any = None
    """The emulator's end of the link, a `MemoryPipe`."""


class Hardware(NamedTuple):
    """Emulated robot on this machine, in real time."""

    address: str
    """Address of the robot."""
    bench: Bench
    """Bench with the arm."""
    acts: Mapping[str, Callable[[], object]]
    """Actions at the robot, by the word that triggers them."""
    advance: Callable[[float], None]
    """Advances bench and robot to a time [s]; called each millisecond."""
    close: Callable[[], None]
    """Switches the robot off."""


def no_emulator(*_: object) -> Any:
    """Refuse; the default of emulations."""
    raise InputError("this robot is not emulated; give the address of one that exists")


class RobotPlugin(Value):
    """A kind of robot, by the scheme of its addresses."""

    open: Callable[[str, Session], Robot]
    """Returns the driver for an address, without opening anything; raises `InputError` if the
    address is invalid."""
    paced: bool = False
    """Whether the robot sets the pace, and requests setpoints by itself. Its driver is then a
    `Clock`, too, which answers it while the loop waits."""
    bench: Callable[[Bodies], Any] = SimulatedRig
    """Makes the bench of the emulator: a `SimulatedRig`, or another with its acts and its angle."""
    emulate: Callable[[Any, Session, float], Emulated] = no_emulator
    """Returns the driver in front of an emulator. Arguments: the bench, whose `body` the emulator
    moves and measures, the driver's session, and the delay of the link each way [s]."""
    hardware: Callable[[Bodies, int | None, Callable[[str], None]], Hardware] = no_emulator
    """Switches emulated hardware on, in real time. Arguments: the bodies, the port (0 for a free
    one, None for the usual one), and what receives a text for each event."""
    servo: TwinSettings = TwinSettings()
    """Numbers of the robot's servo on a twin; those given replace the world's: transport, cycle,
    shaped, lag."""
    flange_speed: Callable[[Arm, float], float] | None = None
    """Returns the largest flange speed [m/s] for the longest time between two setpoints [s]. A run
    over a slow link stops there. None where the link limits no speed."""
    failure: str = (
        "If this computer or the cable fails, software cannot stop the arm. The E-stop can."
    )
    """Behaviour of the arm when this computer fails; shown to the operator before each run."""
    checklist: tuple[tuple[str, str], ...] = ()
    """Safety questions before each run, besides those for any robot: the word that acknowledges it,
    and the question."""
    restart: str = ""
    """Instruction to the operator before the next connection; empty without one."""


def emulated_board(bench: Any, clock: Clock, counts_per_rev: int, sign: int) -> Emulated:
    """Return the driver of the serial encoder in front of its emulated board."""
    return sensor_plugin("serial").emulate(bench, clock, counts_per_rev, sign)


class SensorPlugin(Value):
    """A kind of angle sensor, by the scheme of its addresses."""

    open: Callable[[str, Session, int | None, int], AngleSensor]
    """Returns the driver for an address, without opening anything; raises `InputError` if the
    address is invalid. Arguments: the address, the session, the expected counts per revolution
    (None accepts any number), and the sign: 1 if counts grow with theta, else -1."""
    emulate: Callable[[Any, Clock, int, int], Emulated] = emulated_board
    """Returns the driver in front of an emulator, for a twin with the sensor that `rig.toml` names;
    by default that of the serial encoder. Arguments: the bench, the clock, the expected counts per
    revolution, and the sign."""


def scheme_of(address: str) -> str:
    """Return the scheme of an address: the part before the first colon."""
    return address.partition(":")[0]


def robot_plugin(address: str) -> RobotPlugin:
    """Return the plugin for the address, or the scheme, of a robot.

    Raises:
        InputError: No installed package registers that scheme.
    """
    return _loaded("equipoise.robots", address, RobotPlugin)


def sensor_plugin(address: str) -> SensorPlugin:
    """Return the plugin for the address, or the scheme, of an angle sensor.

    Raises:
        InputError: No installed package registers that scheme.
    """
    return _loaded("equipoise.sensors", address, SensorPlugin)


def _loaded(group: str, address: str, kind: type[Plugin]) -> Plugin:
    points, scheme = registered(group), scheme_of(address)
    if scheme not in points:
        known = f"expected one that begins with {', '.join(f'{name}:' for name in sorted(points))}"
        raise InputError(f"{address!r} is no known address; {how_to_install(scheme) or known}")
    plugin = points[scheme].load()
    if not isinstance(plugin, kind):
        raise InputError(
            f"{address}: its package registers a {type(plugin)}, not a {kind.__name__}"
        )
    return plugin
