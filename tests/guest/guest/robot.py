"""A robot that sets the pace: every 4 ms it sends its joints, and expects the next setpoint.

Both sides send frames of one size over TCP: a kind, then the joints [rad] and the external torques
[N m], as little-endian doubles. The robot stops by itself where six requests have no answer.
"""

import socket
import struct
from collections import deque
from contextlib import suppress
from urllib.parse import urlsplit

import numpy as np

from equipoise.errors import InputError, LinkError
from equipoise.model.worlds import TwinSettings
from equipoise.rig.interfaces import Request, checked_setpoint
from equipoise.rig.plugins import Emulated, RobotPlugin
from equipoise.rig.transports import SocketTransport, memory_pipe

MEASURE, START, STOP, SETPOINT, REQUEST, STOPPED = range(6)
PERIOD_MS = 4
UNANSWERED = 6
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
        return [(kind, numbers[:n], numbers[n:]) for kind, *numbers in frames]


class GuestRobot:
    """The driver: a `PacedRobot`."""

    def __init__(self, open_link, session, joints=JOINTS):
        self.joints, self._frames = joints, Frames(joints)
        self._open, self._clock, self._link = open_link, session.clock, None
        self._requests, self._measured, self._failure = deque(), None, ""

    def connect(self):
        self._link = self._open()
        self.measured()

    def measured(self):
        self._measured = None
        self._send(MEASURE)
        return np.array(self._wait_for_joints())

    def start(self):
        self._requests.clear()
        self._measured = None
        self._send(START)
        self._wait_for_joints()

    def request(self, until):
        self._read()
        while not self._requests and self._clock.now() < until:
            self._clock.wait_until(min(self._clock.now() + 1e-3, until))
            self._read()
        return self._requests[0] if self._requests else None

    def answer(self, q):
        self._requests.popleft()
        self._send(SETPOINT, tuple(checked_setpoint(q, self.joints).tolist()))

    def stop(self):
        self._measured = None
        self._send(STOP)
        self._wait_for_joints()
        self._requests.clear()

    def close(self):
        if self._link is not None:
            with suppress(LinkError):
                self._send(STOP)
            self._link.close()
            self._link = None

    def _send(self, kind, q=None):
        self._working().write(self._frames.pack(kind, q))

    def _read(self):
        for kind, q, torque in self._frames.feed(self._working().read()):
            if kind == STOPPED:
                self._fail(f"the guest's robot stopped: {UNANSWERED} requests had no answer")
            if kind == REQUEST:
                self._requests.append(Request(self._clock.now(), tuple(q), tuple(torque)))
            else:
                self._measured = q

    def _wait_for_joints(self):
        deadline = self._clock.now() + TIMEOUT
        while self._measured is None:
            if self._clock.now() > deadline:
                self._fail(f"the guest's robot said nothing for {TIMEOUT:g} s; switch it on")
            self._clock.wait_until(self._clock.now() + 1e-3)
            self._read()
        return self._measured

    def _working(self):
        if self._failure or self._link is None:
            raise LinkError(self._failure or "the guest's robot is not connected; connect first")
        return self._link

    def _fail(self, why):
        self._failure = why
        raise LinkError(why)


class GuestController:
    """The emulated robot: frames in, frames out, in front of any simulated arm."""

    def __init__(self, body, joints):
        self._body, self._frames = body, Frames(joints)
        self._out, self._ms, self._open = b"", 0, 0
        self.streams = False

    def feed(self, data):
        for kind, q, _ in self._frames.feed(data):
            if kind == SETPOINT and self.streams:
                self._open = max(self._open - 1, 0)
                self._body.target(q)
            elif kind in (START, STOP):
                self.streams, self._open = kind == START, 0
                self._body.servo(self.streams)
            if kind != SETPOINT:
                self._say(MEASURE)

    def advance(self):
        """Let a millisecond pass; return the bytes to send."""
        self._ms += 1
        if self.streams and self._ms % PERIOD_MS == 0:
            self._open += 1
            if self._open > UNANSWERED:
                self.streams = False
                self._body.servo(False)
            self._say(REQUEST if self.streams else STOPPED)
        out, self._out = self._out, b""
        return out

    def _say(self, kind):
        q, torque = self._body.measured(), self._body.torques(external=True)
        self._out += self._frames.pack(kind, tuple(q), tuple(torque))


def host_and_port(address):
    with suppress(ValueError):
        parts = urlsplit(address)
        if parts.hostname and parts.port:
            return parts.hostname, parts.port
    raise InputError(f"{address!r} is no address of a guest's robot; expected guest://HOST:4000")


def open_robot(address, session):
    where = host_and_port(address)

    def connected():
        try:
            return SocketTransport(socket.create_connection(where, timeout=2.0))
        except OSError as error:
            raise LinkError(f"no connection to {address} ({error}); switch the robot on") from None

    return GuestRobot(connected, session)


def emulate(rig, arm, session, delay, seed):
    controller = GuestController(rig.body, rig.joints)
    here, there = memory_pipe(session.clock, delay)

    def advance(now):
        with suppress(LinkError):  # the driver has closed the link
            controller.feed(there.read())
            there.write(controller.advance())

    driver = GuestRobot(lambda: here, session, rig.joints)
    return Emulated(driver, advance, controller, there)


PLUGIN = RobotPlugin(
    open=open_robot,
    emulate=emulate,
    servo=TwinSettings(transport=0.0045),
    failure="If this computer or the cable fails, the robot stops by itself within 24 ms.",
    restart="switch the robot's servo on",
)
