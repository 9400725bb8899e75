"""Plugins of robots and angle sensors, by the scheme of their addresses.

A package brings a robot in one file. Its `pyproject.toml` names the plugin; the name of the entry
point is the scheme of the addresses::

    [project.entry-points."equipoise.robots"]
    acme = "acme_robot:PLUGIN"

After its installation, `equipoise deploy --robot acme://HOST` opens that robot, and
`--robot acme://twin:nominal` runs its driver against its emulator on a digital twin, in virtual
time. Sensors register under `equipoise.sensors`. The robots and sensors of this package register
in the same way. `equipoise.rig.config` is the only module that opens devices.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final, NamedTuple, Protocol, TypeVar

from equipoise.errors import InputError
from equipoise.model.arms.arm import Arm
from equipoise.rig.interfaces import AngleSensor, Clock, PacedRobot, Robot, Transport
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.user_code import guest_code

ROBOTS: Final = "equipoise.robots"
"""Entry-point group of robots."""
SENSORS: Final = "equipoise.sensors"
"""Entry-point group of angle sensors."""
HOOKS: Final = ("open", "emulate", "serve", "flange_speed")
"""Optional functions of a plugin."""


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


class EmulatedRobot(NamedTuple):
    """A driver in front of an emulated robot, in virtual time."""

    robot: Robot | PacedRobot
    """The driver, not yet connected."""
    advance: Callable[[float], None] = ignore
    """Advances the emulator to a time [s]; called each millisecond, after the arm has moved."""
    server: Any = None
    """The emulator, for tests that inject faults."""
    link: Any = None
    """The emulator's end of the link, a `MemoryPipe`."""
    driver: Callable[[Callable[[], Transport], Clock], Robot] | None = None
    """Makes another driver on a transport, for tests that damage bytes."""


class EmulatedSensor(NamedTuple):
    """A driver in front of an emulated angle sensor, in virtual time; see `EmulatedRobot`."""

    sensor: AngleSensor
    """The driver, not yet connected."""
    advance: Callable[[float], None] = ignore
    """Advances the emulator to a time [s]; called each millisecond, after the arm has moved."""
    board: Any = None
    """The emulator, for tests that inject faults."""
    link: Any = None
    """The emulator's end of the link, a `MemoryPipe`."""
    driver: Callable[[Callable[[], Transport], Clock], AngleSensor] | None = None
    """Makes another driver on a transport, for tests that damage bytes."""


class ServerOptions(NamedTuple):
    """Environment of an emulated robot in real time (`equipoise rig emulate`)."""

    rig: SimulatedRig
    """Arm and pendulum; the emulator drives `rig.body`."""
    arm: Arm
    """The arm, with the limits of its joints."""
    clock: Clock
    """Clock of the machine."""
    work: Callable[[float], None]
    """Advances arm, pendulum and encoder to a time [s]; to be called each millisecond."""
    say: Callable[[str], None]
    """Shows an event to the user."""
    attended: bool
    """Whether an emulated operator restarts the robot where a person would."""
    faults: str
    """Faults of the robot's replies, as typed by the user; empty without faults."""
    seed: int
    """Seed of random faults."""


class RobotServer(Protocol):
    """An emulated robot in real time, on a port of this machine."""

    @property
    def acts(self) -> Mapping[str, Callable[[], object]]:
        """Actions of a person at the robot's panel, by the word that triggers them."""
        ...

    def run(
        self, host: str, port: int, stop: Callable[[], bool], listening: Callable[[int], None]
    ) -> None:
        """Serve clients until stopped.

        Args:
            host: Address to listen on.
            port: Port to listen on; for 0 the system chooses one.
            stop: Returns whether to stop; to be called each millisecond.
            listening: Receives the port once a client can connect; called once.

        Raises:
            OutsideError: The port is not available.
        """


class RobotPlugin(NamedTuple):
    """A kind of robot, by the scheme of its addresses. Only `form` and `check` are required."""

    form: str
    """Form of an address, for messages, e.g. `kst://HOST:30001`."""
    check: Callable[[str], object]
    """Raises `InputError` if an address is invalid; opens nothing."""
    open: Callable[[str, Session], Robot | PacedRobot] | None = None
    """Returns the driver for an address, without opening anything. None for a robot that exists in
    virtual time only."""
    emulate: Callable[[SimulatedRig, Arm, Session, float, int], EmulatedRobot] | None = None
    """Returns the driver in front of an emulator. Arguments: the simulated rig whose `body` the
    emulator moves and measures, the arm, the driver's session, the delay of the link each way [s],
    and a seed. None without an emulator."""
    serve: Callable[[ServerOptions], RobotServer] | None = None
    """Returns an emulator in real time for `equipoise rig emulate`. None without one."""
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

    form: str
    """Form of an address, for messages, e.g. `serial:///dev/ttyACM0`."""
    check: Callable[[str], object]
    """Raises `InputError` if an address is invalid; opens nothing."""
    open: Callable[[str, Session, int | None, int], AngleSensor] | None = None
    """Returns the driver for an address, without opening anything. Arguments: the address, the
    session, the expected counts per revolution (None accepts any number), and the sign: 1 if counts
    grow with theta, else -1. None for a sensor that exists in virtual time only."""
    emulate: Callable[[SimulatedRig, Clock, int, int, int], EmulatedSensor] | None = None
    """Returns the driver in front of an emulator. Arguments: the simulated rig, the clock, the
    expected counts per revolution, the sign, and a seed. None without an emulator."""


T = TypeVar("T", RobotPlugin, SensorPlugin)


@cache
def _registered(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}


def scheme_of(address: str) -> str:
    """Return the scheme of an address: the part before the first colon."""
    return address.partition(":")[0]


def robot_plugin(address: str) -> RobotPlugin:
    """Return the plugin for the address, or the scheme, of a robot.

    Raises:
        InputError: No installed package registers that scheme, or its plugin is defective.
    """
    return _plugin(ROBOTS, RobotPlugin, address, "a robot")


def sensor_plugin(address: str) -> SensorPlugin:
    """Return the plugin for the address, or the scheme, of an angle sensor.

    Raises:
        InputError: No installed package registers that scheme, or its plugin is defective.
    """
    return _plugin(SENSORS, SensorPlugin, address, "an encoder")


def _plugin(group: str, type_: type[T], address: str, kind: str) -> T:
    registered = _registered(group)
    entry = registered.get(scheme_of(address))
    if entry is None:
        forms = set[str]()
        for one in registered.values():
            with suppress(InputError):  # a defective plugin does not hide the others
                forms.add(_loaded(one, type_).form)
        expected = " or ".join(sorted(forms))
        raise InputError(f"{address!r} is no address of {kind}; expected {expected}")
    return _loaded(entry, type_)


def _loaded(entry: EntryPoint, type_: type[T]) -> T:
    """Return the plugin of an entry point; errors in its functions name it."""
    what, cure = f"the plugin {entry.name} ({entry.value})", "repair or remove its package"

    def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            with guest_code(what, cure):
                return function(*arguments)

        return call

    with guest_code(what, cure):
        plugin = entry.load()
        if not isinstance(plugin, type_):
            found = type(plugin).__name__
            raise InputError(f"{what} is of type {found}, expected {type_.__name__}; {cure}")
        given = plugin._asdict()
        hooks = {name: guarded(given[name]) for name in HOOKS if given.get(name) is not None}
        return plugin._replace(form=str(plugin.form), check=guarded(plugin.check), **hooks)
