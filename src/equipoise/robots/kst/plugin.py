"""The plugin of KUKA arms behind a KST server: `kst://HOST:30001`."""

from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Final
from urllib.parse import urlsplit

from equipoise.errors import InputError, LinkError
from equipoise.model.arms.arm import Arm
from equipoise.rig.plugins import Emulated, RobotPlugin, Session
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import memory_pipe
from equipoise.robots.kst.codec import PORT
from equipoise.robots.kst.robot import KstRobot, dial
from equipoise.robots.kst.server_emulator import Faults, KstServer
from equipoise.robots.kst.slow_link import flange_speed

MAX_FAULTS: Final = {"delay": 10.0, "jitter": 10.0, "drop": 1.0, "refuse": 1.0}
"""Largest values of the faults that a user may inject: times [s] and shares [-]."""


def host_and_port(address: str) -> tuple[str, int]:
    """Return the host and the port of an address.

    Raises:
        InputError: The address is invalid.
    """
    with suppress(ValueError):  # an open bracket, an invalid port, a name that is no host's
        parts = urlsplit(address)
        port = PORT if parts.port is None else parts.port
        if parts.hostname and port > 0 and not parts.path.strip("/") and not parts.query:
            parts.hostname.encode("idna")
            return parts.hostname, port
    raise InputError(
        f"{address!r} is no address of a KUKA arm; expected kst://HOST:{PORT}, with the name or "
        "number of the cabinet such as 172.31.1.147"
    )


def open_robot(address: str, session: Session) -> KstRobot:
    """Return the driver for an address; nothing is opened before it is connected."""
    clock, notify, attend = session
    return KstRobot(dial(*host_and_port(address)), clock, notify=notify, attend=attend)


def emulate(
    rig: SimulatedRig, arm: Arm, session: Session, delay: float, seed: int
) -> Emulated[KstRobot]:
    """Return the driver in front of an emulated server that drives a simulated arm."""
    server = KstServer(rig.body, rig.joints, seed=seed)
    host, cabinet = memory_pipe(session.clock, delay)

    def advance(now: float) -> None:
        data = b""
        with suppress(LinkError):  # a closed link gets no reply; the servo continues
            data = cabinet.read()
        server.feed(data, now)
        for segment in server.advance(now):
            with suppress(LinkError):
                cabinet.write(segment)

    driver = partial(KstRobot, joints=rig.joints)
    return Emulated(driver(lambda: host, session.clock), advance, server, cabinet, driver)


def serve(rig: SimulatedRig, arm: Arm, faults: str, seed: int) -> KstServer:
    """Return an emulated server with faults such as `delay=0.002,drop=0.01`.

    Raises:
        InputError: A fault is unknown, or its number is invalid or too large.
    """
    numbers: dict[str, float] = {}
    for part in filter(None, map(str.strip, faults.split(","))):
        name, _, number = part.partition("=")
        with suppress(ValueError):
            numbers[name] = float(number)
        if not 0.0 <= numbers.get(name, -1.0) <= MAX_FAULTS.get(name, -1.0):
            known = ", ".join(f"{fault}=0 to {limit:g}" for fault, limit in MAX_FAULTS.items())
            raise InputError(f"--inject says {part!r}; expected any of {known}")
    return KstServer(rig.body, rig.joints, faults=replace(Faults(), **numbers), seed=seed)


PLUGIN: Final = RobotPlugin(
    open=open_robot,
    emulate=emulate,
    serve=serve,
    flange_speed=flange_speed,
    failure=(
        "A KST server has no watchdog: if this computer or the cable fails, the arm goes on to its "
        "last target, which is always near, and software cannot stop it. The E-stop can."
    ),
    restart="start the server's application on the smartPAD",
)
"""Registered as `kst`."""
