"""A robot that answers each setpoint with its joints and torques.

Both sides send frames of one size over TCP: a kind, then the joints [rad] and the external torques
[N m], as little-endian doubles. Each frame has one answer of its kind, in order.
"""

import socket
import struct
from collections import deque
from contextlib import suppress
from urllib.parse import urlsplit

import numpy as np

from equipoise.errors import InputError, LinkError
from equipoise.model.worlds import TwinSettings
from equipoise.rig.interfaces import Reply, checked_setpoint
from equipoise.rig.plugins import Emulated, RobotPlugin
from equipoise.rig.transports import SocketTransport, memory_pipe

MEASURE, START, STOP, SETPOINT = range(4)
TIMEOUT = 0.5
JOINTS = 7


class Frames:
    """Frames of a robot with some joints."""

    def __init__(self, joints):
        self.layout = struct.Struct(f"<B{2 * joints}d")
        self.joints, self._rest = joints, b""

    def pack(self, kind, q=None, torque=None):
        nothing = (0.0,) * self.joints
        return self.layout.pack(kind, *(q or nothing), *(torque or nothing))

    def feed(self, data):
        """Return kind, joints and torques of each frame that is complete."""
        data, size, n = self._rest + data, self.layout.size, self.joints
        whole = len(data) // size * size
        self._rest = data[whole:]
        frames = (self.layout.unpack(data[i : i + size]) for i in range(0, whole, size))
        return [(kind, tuple(numbers[:n]), tuple(numbers[n:])) for kind, *numbers in frames]


class GuestRobot:
    """The driver."""

    def __init__(self, open_link, session, joints=JOINTS):
        self.joints, self._frames = joints, Frames(joints)
        self._open, self._clock, self._link = open_link, session.clock, None
        self._sent, self._replies = deque(), []
        self._joints, self._streams, self._failure = None, False, ""

    def connect(self):
        self._link = self._open()
        self.measured()

    def measured(self):
        return self._ask(MEASURE)

    def start(self):
        self._ask(START)
        self._streams = True
        return self.measured()

    def send(self, q):
        setpoint = checked_setpoint(q, self.joints)
        link = self._working()
        if not self._streams:
            raise LinkError("the user's servo does not run; start it first")
        link.write(self._frames.pack(SETPOINT, setpoint.tolist()))
        self._sent.append(self._clock.now())

    def replies(self):
        self._read()
        if self._sent and self._clock.now() > self._sent[0] + TIMEOUT:
            self._fail(f"the user's robot did not answer a setpoint within {TIMEOUT:g} s")
        replies, self._replies = self._replies, []
        return replies

    def stop(self):
        self._ask(STOP)
        self._streams = False

    def close(self):
        if self._link is not None:
            with suppress(LinkError):
                self._link.write(self._frames.pack(STOP))
            self._link.close()
            self._link = None

    def _ask(self, kind):
        self._working().write(self._frames.pack(kind))
        self._joints, deadline = None, self._clock.now() + TIMEOUT
        while self._joints is None:
            if self._clock.now() > deadline:
                self._fail(f"the user's robot said nothing for {TIMEOUT:g} s; switch it on")
            self._clock.wait_until(self._clock.now() + 1e-3)
            self._read()
        return np.array(self._joints)

    def _read(self):
        for kind, q, torque in self._frames.feed(self._working().read()):
            if kind == SETPOINT:
                self._replies.append(Reply(self._sent.popleft(), self._clock.now(), q, torque))
            else:
                self._joints = q

    def _working(self):
        if self._failure or self._link is None:
            raise LinkError(self._failure or "the user's robot is not connected; connect first")
        return self._link

    def _fail(self, why):
        self._failure = why
        raise LinkError(why)


class GuestController:
    """The emulated robot: frames in, frames out, in front of any simulated arm."""

    def __init__(self, body, joints):
        self._body, self._frames = body, Frames(joints)

    def answers(self, data):
        """Obey the frames that have arrived; return the bytes to send."""
        sent = b""
        for kind, q, _ in self._frames.feed(data):
            if kind == SETPOINT:
                self._body.target(q)
            elif kind in (START, STOP):
                self._body.servo(kind == START)
            measured, torque = self._body.measured(), self._body.torques(external=True)
            sent += self._frames.pack(kind, measured, torque)
        return sent


def host_and_port(address):
    with suppress(ValueError):
        parts = urlsplit(address)
        if parts.hostname and parts.port:
            return parts.hostname, parts.port
    raise InputError(f"{address!r} is no address of a user's robot; expected guest://HOST:4000")


def open_robot(address, session):
    where = host_and_port(address)

    def connected():
        try:
            return SocketTransport(socket.create_connection(where, timeout=2.0))
        except OSError as error:
            raise LinkError(f"no connection to {address} ({error}); switch the robot on") from None

    return GuestRobot(connected, session)


def emulate(rig, session, delay):
    controller = GuestController(rig.body, rig.joints)
    here, there = memory_pipe(session.clock, delay)

    def advance(now):
        with suppress(LinkError):  # the driver has closed the link
            there.write(controller.answers(there.read()))

    driver = GuestRobot(lambda: here, session, rig.joints)
    return Emulated(driver, advance, controller, there)


PLUGIN = RobotPlugin(
    open=open_robot,
    emulate=emulate,
    servo=TwinSettings(transport=0.008),
    failure="If this computer or the cable fails, the arm rests at its last setpoint.",
    restart="switch the robot's servo on",
)
