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

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from inspect import getattr_static
from typing import Any, Final, Generic, Literal, NamedTuple, Protocol, TypeVar

from pydantic import ValidationError

from equipoise.arrays import Array
from equipoise.artefacts import Share, Value, first_fault
from equipoise.errors import InputError
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.config import Load
from equipoise.rig.interfaces import AngleSensor, Clock, PacedRobot, Robot, Transport
from equipoise.rig.simulated_rig import Bench, SimulatedRig
from equipoise.user_code import guest_code

Device = TypeVar("Device", bound=Robot | PacedRobot | AngleSensor)


def ignore(*_: object) -> None:
    """Do nothing; the default of optional callbacks."""


class Session(NamedTuple):
    """Environment of a driver: the clock, and ways to reach the operator while it connects."""

    clock: Clock
    """Clock of the rig. A driver waits with `clock.wait_until` only, never with `time.sleep`."""
    notify: Callable[[str], None] = ignore
    """Shows the operator an instruction, for example to start the robot's program."""
    attend: Callable[[], None] = ignore
    """To be called about once a second while `connect` waits for the operator. An exception that
    it raises ends the wait."""
    load: Load | None = None
    """Load on the flange, for a robot that is told it by this computer; None if it is unknown."""


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


class Bodies(NamedTuple):
    """Bodies of a rig that is to be emulated."""

    arm: Arm
    """The arm with its home posture."""
    pendulum: PendulumParameters
    """The true pendulum."""
    settings: TwinSettings
    """Settings of the world."""
    q: Array
    """Free joints at the start [rad], shape (6,)."""
    start: float
    """Start time [s]."""
    seed: int
    """Seed of all random numbers."""


def simulated_rig(bodies: Bodies) -> SimulatedRig:
    """Return a rig with the arm of a twin; the default bench of an emulated robot.

    Raises:
        ArmError: The masses of the arm's links are unknown.
    """
    arm, pendulum, settings, q, start, seed = bodies
    return SimulatedRig(arm, pendulum, settings, seed=seed, start=start, q=q)


class Hardware(Protocol):
    """Emulated robot on this machine, in real time."""

    address: str
    """Address of the robot."""
    acts: dict[str, Callable[[], object]]
    """Actions at the robot, by the word that triggers them."""

    @property
    def bench(self) -> Bench:
        """Bench with the arm."""
        ...

    def advance(self, now: float) -> None:
        """Advance bench and robot to a time [s]; called each millisecond."""

    def close(self) -> None:
        """Switch the robot off."""


class RobotPlugin(Value):
    """A kind of robot, by the scheme of its addresses."""

    open: Callable[[str, Session], Robot | PacedRobot] | None = None
    """Returns the driver for an address, without opening anything; raises `InputError` if the
    address is invalid. None for a robot that exists in virtual time only."""
    bench: Callable[[Bodies], Any] = simulated_rig
    """Makes the bench of the emulator: a `SimulatedRig`, or another with its acts and its angle."""
    emulate: Callable[[Any, Arm, Session, float, int], Emulated[Any]] | None = None
    """Returns the driver in front of an emulator. Arguments: the bench, whose `body` the emulator
    moves and measures, the arm, the driver's session, the delay of the link each way [s], and a
    seed. None without an emulator."""
    hardware: Callable[[Bodies, int | None, Callable[[str], None]], Hardware] | None = None
    """Switches emulated hardware on, in real time. Arguments: the bodies, the port (0 for a free
    one, None for the usual one), and what receives a text for each event. None without hardware."""
    link_share: Share = 0.5
    """Share of the twin's reply age that the emulated link takes each way [-]. The rest of the
    twin's transport time stays in the servo."""
    servo: TwinSettings = TwinSettings()
    """Numbers of the robot's servo on a twin; those given replace the world's: transport, cycle,
    shaped, inner, lag."""
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


class SensorPlugin(Value):
    """A kind of angle sensor, by the scheme of its addresses."""

    open: Callable[[str, Session, int | None, int], AngleSensor] | None = None
    """Returns the driver for an address, without opening anything; raises `InputError` if the
    address is invalid. Arguments: the address, the session, the expected counts per revolution
    (None accepts any number), and the sign: 1 if counts grow with theta, else -1. None for a sensor
    that exists in virtual time only."""
    emulate: Callable[[SimulatedRig, Clock, int, int, int], Emulated[AngleSensor]] | None = None
    """Returns the driver in front of an emulator. Arguments: the simulated rig, the clock, the
    expected counts per revolution, the sign, and a seed. None without an emulator."""


T = TypeVar("T", bound=RobotPlugin | SensorPlugin)

CURE: Final = "repair or remove its package"
"""Remedy for a defective plug-in."""


def scheme_of(address: str) -> str:
    """Return the scheme of an address: the part before the first colon."""
    return address.partition(":")[0]


def robot_plugin(address: str) -> RobotPlugin:
    """Return the plugin for the address, or the scheme, of a robot.

    Raises:
        InputError: No installed package registers that scheme, or its plugin is defective.
    """
    return _load(_registered(RobotPlugin, address), RobotPlugin)


def make_driver(
    kind: type[RobotPlugin | SensorPlugin],
    function: Literal["open", "emulate"],
    address: str,
    *arguments: Any,
) -> Any:
    """Call a function of the plugin for an address or a scheme, and check the driver it returns.

    Args:
        kind: Kind of the plugin.
        function: Field of the plugin.
        address: The address, or its scheme.
        arguments: Arguments of the function.

    Raises:
        InputError: The plugin is missing or defective, or the driver lacks a method.
    """
    point = _registered(kind, address)
    make, what = getattr(_load(point, kind), function), _name(point)
    if make is None:
        raise InputError(f"{what} has no {function}, which {address} needs; {CURE}")
    with guest_code(what, CURE):
        made = make(*arguments)
        if function == "emulate" and not isinstance(made, Emulated):
            found = type(made).__name__
            raise InputError(f"{what}: emulate returns a {found}, expected an Emulated; {CURE}")
        device = made.device if function == "emulate" else made
        protocol = PacedRobot if hasattr(device, "request") else Robot
        protocol = AngleSensor if kind is SensorPlugin else protocol
        names = [name for name in dir(protocol) if not name.startswith("_")]
        if missing := [name for name in names if getattr_static(device, name, None) is None]:
            raise InputError(
                f"{what}: its driver, a {type(device).__name__}, is no {protocol.__name__}, "
                f"without {', '.join(missing)}; {CURE}"
            )
        return made


def _registered(kind: type[RobotPlugin | SensorPlugin], address: str) -> EntryPoint:
    group = "equipoise.robots" if kind is RobotPlugin else "equipoise.sensors"
    registered, scheme = {one.name: one for one in entry_points(group=group)}, scheme_of(address)
    if scheme not in registered:
        known = ", ".join(f"{name}:" for name in sorted(registered))
        raise InputError(f"{address!r} is no known address; expected one that begins with {known}")
    return registered[scheme]


def _name(point: EntryPoint) -> str:
    return f"the plug-in {point.name} = {point.value!r}"


def _load(point: EntryPoint, kind: type[T]) -> T:
    what = _name(point)
    with guest_code(what, CURE):
        try:
            plugin = point.load()
        except ValidationError as error:
            raise InputError(f"{what}: {first_fault(error)}; {CURE}") from None
        if not isinstance(plugin, kind):
            found = type(plugin).__name__
            raise InputError(f"{what} is a {found}, expected a {kind.__name__}; {CURE}")
        return plugin
