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
from importlib.metadata import entry_points
from typing import Any, Generic, NamedTuple, TypeVar

from equipoise.errors import InputError
from equipoise.model.arms.arm import Arm
from equipoise.rig.interfaces import AngleSensor, Clock, PacedRobot, Robot, Transport
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.user_code import guest_code

Device = TypeVar("Device", bound=Robot | PacedRobot | AngleSensor)


def ignore(*_: object) -> None:
    """Do nothing; the default of optional callbacks."""


class Session(NamedTuple):
    """Environment of a driver: the clock, and ways to reach the operator while it connects."""

    clock: Clock
    """Clock of the rig. A driver waits with `clock.wait_until` only, never with `time.sleep`."""
    notify: Callable[[str], None] = ignore
    """Shows the operator an instruction, for example to start a server."""
    attend: Callable[[], None] = ignore
    """To be called about once a second while `connect` waits for the operator. An exception that
    it raises ends the wait."""


class Emulated(NamedTuple, Generic[Device]):
    """A driver in front of an emulated device, in virtual time."""

    device: Device
    """The driver, not yet connected."""
    advance: Callable[[float], None] = ignore
    """Advances the emulator to a time [s]; called each millisecond, after the arm has moved."""
    emulator: Any = None
    """The emulator, for tests that inject faults."""
    link: Any = None
    """The emulator's end of the link, a `MemoryPipe`."""
    driver: Callable[[Callable[[], Transport], Clock], Device] | None = None
    """Makes another driver on a transport, for tests that damage bytes."""


class RobotPlugin(NamedTuple):
    """A kind of robot, by the scheme of its addresses."""

    open: Callable[[str, Session], Robot | PacedRobot] | None = None
    """Returns the driver for an address, without opening anything; raises `InputError` if the
    address is invalid. None for a robot that exists in virtual time only."""
    emulate: Callable[[SimulatedRig, Arm, Session, float, int], Emulated[Any]] | None = None
    """Returns the driver in front of an emulator. Arguments: the simulated rig whose `body` the
    emulator moves and measures, the arm, the driver's session, the delay of the link each way [s],
    and a seed. None without an emulator."""
    link_share: float = 0.5
    """Share of the twin's reply age that the emulated link takes each way [-]. The rest of the
    twin's transport time stays in the servo."""
    servo: Mapping[str, Any] = {}
    """Numbers of the robot's servo on a twin, as fields of `TwinSettings`, where they differ from
    the world's: transport, cycle, shaped, inner, lag."""
    flange_speed: Callable[[Arm, float], float] | None = None
    """Returns the largest flange speed [m/s] for the longest time between two setpoints [s]. A run
    over a slow link stops there. None where the link limits no speed."""
    failure: str = (
        "If this computer or the cable fails, software cannot stop the arm. The E-stop can."
    )
    """Behaviour of the arm when this computer fails; shown to the operator before each run."""
    restart: str = ""
    """Instruction to the operator before the next connection; empty without one."""


class SensorPlugin(NamedTuple):
    """A kind of angle sensor, by the scheme of its addresses."""

    open: Callable[[str, Session, int | None, int], AngleSensor] | None = None
    """Returns the driver for an address, without opening anything; raises `InputError` if the
    address is invalid. Arguments: the address, the session, the expected counts per revolution
    (None accepts any number), and the sign: 1 if counts grow with theta, else -1. None for a sensor
    that exists in virtual time only."""
    emulate: Callable[[SimulatedRig, Clock, int, int, int], Emulated[AngleSensor]] | None = None
    """Returns the driver in front of an emulator. Arguments: the simulated rig, the clock, the
    expected counts per revolution, the sign, and a seed. None without an emulator."""


T = TypeVar("T", RobotPlugin, SensorPlugin)


def scheme_of(address: str) -> str:
    """Return the scheme of an address: the part before the first colon."""
    return address.partition(":")[0]


def robot_plugin(address: str) -> RobotPlugin:
    """Return the plugin for the address, or the scheme, of a robot.

    Raises:
        InputError: No installed package registers that scheme, or its plugin is defective.
    """
    return _load("equipoise.robots", RobotPlugin, address)


def sensor_plugin(address: str) -> SensorPlugin:
    """Return the plugin for the address, or the scheme, of an angle sensor.

    Raises:
        InputError: No installed package registers that scheme, or its plugin is defective.
    """
    return _load("equipoise.sensors", SensorPlugin, address)


def _load(group: str, type_: type[T], address: str) -> T:
    registered, scheme = {one.name: one for one in entry_points(group=group)}, scheme_of(address)
    if scheme not in registered:
        known = ", ".join(f"{name}:" for name in sorted(registered))
        raise InputError(f"{address!r} is no known address; expected one that begins with {known}")
    with guest_code(f"the plugin {scheme}", "repair or remove its package"):
        plugin = registered[scheme].load()
        if not isinstance(plugin, type_):
            raise InputError(f"the plugin {scheme} is a {type(plugin)}, expected {type_.__name__}")
        return plugin
