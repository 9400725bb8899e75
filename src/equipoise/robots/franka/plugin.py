"""The plugin of Franka Research 3: `franka://HOST`."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final
from urllib.parse import urlsplit

from equipoise.errors import InputError, import_optional
from equipoise.model.arms.arm import Arm
from equipoise.rig.plugins import Bodies, Emulated, Hardware, RobotPlugin, Session
from equipoise.robots.franka.robot import FrankaRobot


def host_of(address: str) -> str:
    """Return the host of an address.

    Raises:
        InputError: The address is invalid.
    """
    with suppress(ValueError):  # an open bracket, an invalid port
        parts = urlsplit(address)
        if parts.hostname and parts.port is None and not (parts.path.strip("/") or parts.query):
            return parts.hostname
    raise InputError(
        f"{address!r} is no address of an FR3; expected franka://HOST, with the name or number of "
        "its controller such as 172.16.0.2, without a port"
    )


def open_robot(address: str, session: Session) -> FrankaRobot:
    """Return the driver for an address; nothing is opened before it is connected."""
    return FrankaRobot(host_of(address), session.clock, load=session.load)


def bench(bodies: Bodies) -> Any:
    """Return a rig on `franky-sim`, in lockstep.

    Raises:
        MissingExtraError: `franky-sim` is not installed.
    """
    import_optional("franky_sim", "peers")
    from equipoise.robots.franka.lockstep import Lockstep

    return Lockstep(bodies)


def emulate(rig: Any, arm: Arm, session: Session, delay: float, seed: int) -> Emulated[FrankaRobot]:
    """Return the driver in front of a rig on `franky-sim`."""
    return Emulated(FrankaRobot(rig.host, session.clock, load=session.load), emulator=rig)


def hardware(bodies: Bodies, port: int | None, say: Callable[[str], None]) -> Hardware:
    """Return emulated hardware on `franky-sim`.

    Raises:
        MissingExtraError: `franky-sim` is not installed.
    """
    import_optional("franky_sim", "peers")
    from equipoise.robots.franka.franky import FrankyHardware

    return FrankyHardware(bodies, port, say)


PLUGIN: Final = RobotPlugin(
    open=open_robot,
    bench=bench,
    emulate=emulate,
    hardware=hardware,
    failure=(
        "If this computer or the cable fails, the controller stops the arm within 20 ms. Keep the "
        "emergency stop at hand."
    ),
    checklist=(("load", "Is the load of bracket and pendulum set?"),),
    restart="unlock the joints and activate FCI in Desk",
)
"""Registered as `franka`."""
