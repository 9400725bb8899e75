"""The plugin of KUKA arms behind a KST server: `kst://HOST:30001`."""

from contextlib import suppress
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
from equipoise.robots.kst.server_emulator import KstServer
from equipoise.robots.kst.slow_link import flange_speed


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


PLUGIN: Final = RobotPlugin(
    open=open_robot,
    emulate=emulate,
    flange_speed=flange_speed,
    failure=(
        "A KST server has no watchdog: if this computer or the cable fails, the arm goes on to its "
        "last target, which is always near, and software cannot stop it. The E-stop can."
    ),
    restart="start the server's application on the smartPAD",
)
"""Registered as `kst`."""
