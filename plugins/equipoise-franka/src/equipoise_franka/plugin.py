"""The plugin of Franka Research 3: `franka://HOST`, and the twin `twin:fr3`."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final
from urllib.parse import urlsplit

from equipoise.errors import InputError
from equipoise.rig.plugins import Emulated, Hardware, RobotPlugin, Session
from equipoise.rig.simulated_rig import Bodies
from equipoise_franka.lockstep import Lockstep, require_emulator
from equipoise_franka.robot import FrankaRobot

TWIN: Final[Mapping[str, Any]] = {
    "shaped": False,
    "transport": 0.005,
    "transport_jitter": 0.0005,
    "reach_time": 0.004,
    "lag": 0.001,
    "rotor_inertia": (0.195, 0.195, 0.195, 0.195, 0.074),
    "reply_age": 0.001,
}
"""Differences of `twin:fr3` to the nominal twin: delay and lag as identified over the stream of
velocities, rotors of `franky-sim`."""


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
    return FrankaRobot(host_of(address), session)


def emulate(rig: Any, session: Session, delay: float) -> Emulated:
    """Return the driver in front of a rig on `franky-sim`."""
    return Emulated(open_robot(f"franka://{rig.host}", session), emulator=rig)


def hardware(bodies: Bodies, port: int | None, say: Callable[[str], None]) -> Hardware:
    """Return emulated hardware on `franky-sim`.

    Raises:
        InputError: A port is given.
        MissingExtraError: `franky-sim` is not installed.
        OutsideError: The address is not available.
    """
    if port is not None:
        raise InputError("a controller of an FR3 has ports of its own; leave --port out")
    require_emulator()
    from equipoise_franka.franky import HOST, FrankyRig

    bench = FrankyRig(bodies, [HOST], real_time=True)
    controller = bench.controller
    acts = {
        "estop": controller.stop,
        "collide": lambda: controller.stop("joint_reflex"),
        "lock": controller.lock,
        "free": controller.set_free,
    }
    return Hardware(f"franka://{HOST}", bench, acts, bench.advance, bench.close)


PLUGIN: Final = RobotPlugin(
    open=open_robot,
    paced=True,
    bench=Lockstep,
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
