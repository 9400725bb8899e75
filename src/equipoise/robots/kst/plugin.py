"""The plugin of KUKA arms behind a KST server: `kst://HOST:30001`."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final
from urllib.parse import urlsplit

import numpy as np

from equipoise import paper
from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arrays import Array
from equipoise.errors import InputError
from equipoise.model.actuator import speed_of_peak
from equipoise.rig.plugins import Emulated, Hardware, RobotPlugin, Session
from equipoise.rig.simulated_rig import Bodies, SimulatedRig
from equipoise.rig.transports import memory_pipe
from equipoise.robots.kst.codec import PORT
from equipoise.robots.kst.emulator import KstCabinet, KstServer
from equipoise.robots.kst.robot import KstRobot, dial

T1_SPEED: Final = 0.23
"""Flange speed limit of a run in T1 [m/s]: the controller stops the arm with its brakes at 0.25
m/s, and measured speeds are noisy."""
SHAPED_FRACTION: Final = 0.8
"""Maximum fraction of a joint's speed limit for the shaped peak of its velocity [-]."""
TRACK_STEP: Final = 0.005
"""Distance between two evaluated points of the track [m]; the rates of the joints change by 1 %
from one to the next."""


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
    if session.load is not None:
        raise InputError("a KST server takes no load_kg; enter it as a tool in Sunrise.Workbench")
    return KstRobot(partial(dial, *host_and_port(address)), session)


def emulate(rig: SimulatedRig, session: Session, delay: float) -> Emulated:
    """Return the driver in front of an emulated server that drives a simulated arm."""
    host, cabinet = memory_pipe(session.clock, delay)
    server = KstServer(rig.body, cabinet)
    robot = KstRobot(lambda: host, session, joints=rig.joints)
    return Emulated(robot, server.advance, server, cabinet)


def hardware(bodies: Bodies, port: int | None, say: Callable[[str], None]) -> Hardware:
    """Return an emulated cabinet on a TCP port.

    Raises:
        ArmError: The masses of the arm's links are unknown.
        OutsideError: The port is not available.
    """
    cabinet = KstCabinet(bodies, PORT if port is None else port, say)
    bench = cabinet.bench
    acts = {
        "estop": lambda: bench.body.stop("emergency stop"),
        "free": bench.body.set_free,
        "start": cabinet.restart,
    }
    return Hardware(cabinet.address, bench, acts, cabinet.advance, cabinet.close)


def flange_speed(arm: Arm, period: float) -> float:
    """Return the flange speed that brings a joint to its shaped peak, along the track [m/s].

    The servo of a KST server moves towards each setpoint on arrival, at a speed that grows with the
    distance. With a slow stream the joints move in steps that are faster than the commanded motion
    (`equipoise.model.actuator.speed_of_peak`). Their peaks must stay below the speed at which the
    cabinet stops the arm.

    Args:
        arm: The arm with its home posture.
        period: Maximum time between two setpoints [s].
    """
    peaks = [SHAPED_FRACTION * joint.velocity for joint in arm.free_joints]
    allowed = np.array([speed_of_peak(peak, period) for peak in peaks])
    along_x = np.eye(FREE_JOINTS)[0]

    def rates(q: Array) -> Array:
        """Return the rates of the free joints per flange velocity along x [rad/m], shape (6,)."""
        return np.asarray(np.linalg.solve(arm.kinematics(q).jacobian, along_x), np.float64)

    speeds: list[Array] = []
    for ahead in (TRACK_STEP, -TRACK_STEP):
        q = arm.home_free
        for _ in range(round(paper.X_LIMIT / TRACK_STEP) + 1):
            # Avoids a division by zero for a joint that does not move.
            speeds.append(allowed / np.maximum(np.abs(rates(q)), np.finfo(np.float64).tiny))
            q = q + ahead * rates(q + 0.5 * ahead * rates(q))
    return float(np.min(speeds))


PLUGIN: Final = RobotPlugin(
    open=open_robot,
    emulate=emulate,
    hardware=hardware,
    flange_speed=flange_speed,
    failure=(
        "A KST server has no watchdog: if this computer or the cable fails, the arm goes on to its "
        "last target, which is always near, and software cannot stop it. The E-stop can."
    ),
    checklist=(
        ("t1", f"Has this policy run in T1, or is T1 selected, with --max-speed {T1_SPEED}?"),
    ),
    restart="start the server's application on the smartPAD",
)
"""Registered as `kst`."""
