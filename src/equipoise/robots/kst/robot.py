"""Driver of a KUKA iiwa behind a KST server, a `Robot`.

Each request has exactly one reply, in order, within a timeout. Anything else (silence, a reply of
another kind, an unrequested line) ends the link for good, because a reply can no longer be matched
with its request. The driver never repeats a request and never reconnects. A lost reply among many
of one kind shifts all later ones; the next request for torques reveals it, since its reply is then
read as joints that the arm cannot have reached.

`connect`, `start`, `stop` and `close` wait for the races of the server: it acknowledges a servo
before the servo exists, then overwrites its target with the measured joints; and it acknowledges a
command before it is ready for the next.

The server has no watchdog. If this program dies or the link breaks, the servo continues to the last
target, and only the operator can stop it, with the E-stop. The last target must therefore always be
near and slow to reach. A layer above (`equipoise.rig.guarded`) ensures this, and checks
position, velocity and acceleration. This module sends finite numbers only.
"""

import socket
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

import numpy as np

from equipoise.arrays import Array
from equipoise.errors import LinkError, OutsideError
from equipoise.rig.interfaces import Reply, Transport
from equipoise.rig.plugins import Session
from equipoise.rig.transports import SocketTransport
from equipoise.robots.kst import codec

TIMEOUT: Final = 0.1
"""Timeout of the reply to a setpoint [s]. A cabled link takes one or two milliseconds, a garbage
collection on the cabinet tens."""
TORQUE_EVERY: Final = 10
"""Number of setpoints of which one requests external torques: 20 times a second. A reply has joints
or torques, never both."""
REPLY_TIMEOUT: Final = 1.0
"""Timeout of the reply to any other command [s]."""
SERVER_TIMEOUT: Final = 60.0
"""Timeout of the server from its start on the smartPAD to its client, and of `connect` to that
start [s]."""
AFTER_CONNECT: Final = 1.0
"""Delay from the connection to the first command [s], as in both official clients."""
AFTER_START: Final = 0.5
"""Delay from the acknowledgement of a servo to the first setpoint [s] (MATLAB's client: 0.5 s,
iiwaPy3: 0.3 s)."""
BEFORE_STOP: Final = 0.5
"""Delay from the last setpoint to the stop [s], as in MATLAB's client."""
AFTER_STOP: Final = 0.3
"""Delay from the acknowledgement of a stop to the certain end of the servo [s], as in iiwaPy3."""
POLL_PERIOD: Final = 0.001
"""Time between two reads of the link while waiting [s]."""


def dial(host: str, port: int) -> Transport:
    """Open a TCP connection to a KST server.

    Args:
        host: Name or number of the cabinet.
        port: Port of the server.

    Raises:
        LinkError: Nothing listens there yet.
        OutsideError: The name is unknown: starting the application does not help, so do not wait.
    """
    try:
        return SocketTransport(socket.create_connection((host, port), timeout=2.0))
    except OSError as error:
        kind = OutsideError if isinstance(error, socket.gaierror) else LinkError
        raise kind(
            f"no connection to {host}, port {port} ({error}); check cable, address and that "
            "the server has been started"
        ) from None


class KstRobot:
    """Driver of a KST server; see the module."""

    def __init__(
        self,
        open_transport: Callable[[], Transport],
        session: Session,
        *,
        joints: int = codec.JOINTS,
    ) -> None:
        """Create the driver; nothing is opened before `connect`.

        Args:
            open_transport: Opens a connection to the server, or raises `LinkError`.
            session: Its clock, and the operator while `connect` waits.
            joints: Number of joints; other than seven only for an emulated arm.
        """
        self.joints = joints
        """Number of joints, the held one included."""
        self._open, self._session, self._clock = open_transport, session, session.clock
        self._transport: Transport | None = None
        self._failure = ""
        self._streams, self._sent = False, 0
        self._may_move = True  # until the first reply, a servo of a lost client may run
        self._rest = b""  # of the received bytes: the begin of the next line
        self._received: deque[bytes] = deque()
        self._pending: deque[tuple[float, bool]] = deque()
        self._ready: list[Reply] = []
        self._last: tuple[float, tuple[float, ...]] = (0.0, ())

    def connect(self) -> None:
        """Connect to the server, wait for its start if needed, and read the joints.

        Raises:
            LinkError: The server does not start in time, or its reply is missing or invalid.
        """
        if self._transport is not None or self._failure:
            raise LinkError("this connection was used; start the server again for another one")
        self._transport = self._reach()
        self._wait(AFTER_CONNECT)
        self.measured()
        self._may_move = False

    def measured(self) -> Array:
        """Request the measured joints [rad], shape (7,), while no servo runs.

        Raises:
            LinkError: The reply is late or invalid.
        """
        self._require_rest("measure")
        with self._final_errors():
            return np.array(self._request_joints())

    def start(self) -> Array:
        """Start the servo, which holds the arm at its position without a setpoint.

        Returns:
            The joints measured then [rad], shape (7,).

        Raises:
            LinkError: A reply is late or invalid.
        """
        self._require_rest("start a servo")
        self._may_move = True
        with self._final_errors():
            codec.expect_done(self._request(codec.START_SERVO), codec.START_SERVO)
            self._wait(AFTER_START)
            measured = self._request_joints()
        self._streams, self._sent = True, 0
        self._ready.clear()  # replies of a servo before
        self._last = (self._clock.now(), measured)
        return np.array(measured)

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of all joints; each tenth requests torques instead of joints.

        Args:
            q: The joints [rad], shape (7,).

        Raises:
            LinkError: The link is down, no servo runs, or replies are overdue.
            InputError: The setpoint is not seven finite numbers; nothing was sent.
        """
        torque = (self._sent + 1) % TORQUE_EVERY == 0
        line = codec.setpoint(q, torque=torque, joints=self.joints)
        transport = self._link()
        if not self._streams:
            raise LinkError("the servo does not run, so that no setpoint is obeyed; start it first")
        with self._final_errors():
            self._collect()
            # 100 ms of a stream: a run that stops before that can still send its ramp to rest.
            if len(self._pending) >= 20:
                raise LinkError(
                    f"{len(self._pending)} setpoints wait for their answer, expected fewer"
                )
            transport.write(line)
        self._sent += 1
        self._pending.append((self._clock.now(), torque))

    def replies(self) -> list[Reply]:
        """Return the replies since the last call, the oldest first.

        Raises:
            LinkError: The link is down, or a reply is overdue or invalid.
        """
        self._link()
        with self._final_errors():
            self._collect()
        ready, self._ready = self._ready, []
        return ready

    def stop(self) -> None:
        """Stop the servo, the arm at rest; without a servo, do nothing.

        Raises:
            LinkError: A reply is late or invalid.
        """
        self._link()
        if not self._streams:
            return
        with self._final_errors():
            while self._pending:
                self._wait(POLL_PERIOD)
                self._collect()
            self._wait(BEFORE_STOP)
            codec.expect_done(self._request(codec.STOP_SERVO), codec.STOP_SERVO)
        self._streams = False
        self._wait(AFTER_STOP)
        self._may_move = False

    def close(self) -> None:
        """End the server and its servo, and close; an operator has to start the server again."""
        transport, self._transport = self._transport, None
        if transport is None:
            return
        self._failure = self._failure or "the connection was closed"
        with suppress(LinkError):
            transport.write(f"{codec.END}\n".encode())
            # Until the server has closed it: unread bytes may discard the last command.
            deadline = self._clock.now() + 1.0  # [s]
            while self._clock.now() < deadline:
                transport.read()
                self._wait(POLL_PERIOD)
        transport.close()

    def _reach(self) -> Transport:
        """Open the connection, once the operator has started the server."""
        deadline, notified = self._clock.now() + SERVER_TIMEOUT, False
        while True:
            try:
                return self._open()
            except LinkError as error:
                if self._clock.now() >= deadline:
                    raise LinkError(f"no KST server within {SERVER_TIMEOUT:g} s: {error}") from None
            if not notified:
                self._session.notify(
                    "waiting for the robot: start the application MatlabToolboxServer on the "
                    f"smartPAD now; it waits {SERVER_TIMEOUT:g} s for its client"
                )
                notified = True
            self._wait(1.0)
            self._session.attend()

    def _link(self) -> Transport:
        """Return the open link, or raise the error that ended it."""
        if self._failure:
            raise LinkError(self._failure)
        if self._transport is None:
            raise LinkError("the robot is not connected; connect first")
        return self._transport

    def _require_rest(self, purpose: str) -> None:
        self._link()
        if self._streams:
            raise LinkError(f"a servo runs; stop it before you {purpose}")

    @contextmanager
    def _final_errors(self) -> Generator[None]:
        """Give up the link for good on a `LinkError`."""
        try:
            yield
        except LinkError as error:
            consequence = "No servo runs;"
            if self._may_move:
                consequence = (
                    "A servo that runs goes on to the last setpoint, and software cannot stop it: "
                    "be ready at the E-stop, and"
                )
            self._failure = (
                f"robot: {error}; the link is given up. {consequence} start the server again"
            )
            raise LinkError(self._failure) from error

    # Errors below are final: each caller encloses them in `_final_errors`.

    def _request_joints(self) -> tuple[float, ...]:
        reply = self._request(codec.GET_JOINTS)
        return codec.expect_numbers(reply, self.joints, codec.GET_JOINTS)

    def _request(self, command: str) -> bytes:
        """Send a command while no reply is pending, and return its reply."""
        self._collect()
        self._link().write(f"{command}\n".encode())
        deadline = self._clock.now() + REPLY_TIMEOUT
        while not self._received:
            if self._clock.now() >= deadline:
                raise LinkError(f"no answer to {command} came within {REPLY_TIMEOUT:g} s")
            self._wait(POLL_PERIOD)
            self._receive()
        return self._received.popleft()

    def _receive(self) -> None:
        lines, self._rest = codec.split_lines(self._rest + self._link().read())
        self._received.extend(lines)

    def _collect(self) -> None:
        """Match the received lines with the pending setpoints."""
        self._receive()
        now = self._clock.now()
        while self._received:
            line = self._received.popleft()
            if not self._pending:
                raise LinkError(f"expected nothing, got {line[:120].decode('latin-1')!r}")
            sent, torque = self._pending.popleft()
            values = codec.expect_numbers(line, self.joints, "a setpoint")
            if not torque:
                self._check_step(sent, values)
            q, torques = (None, values) if torque else (values, None)
            self._ready.append(Reply(sent, now, q, torques))
        if self._pending and now - self._pending[0][0] > TIMEOUT:
            raise LinkError(f"expected the answer to a setpoint within {TIMEOUT:g} s")

    def _check_step(self, sent: float, q: tuple[float, ...]) -> None:
        """Check that the arm can have reached joints [rad] since the last reply."""
        before, q_before = self._last
        step = max(abs(a - b) for a, b in zip(q, q_before, strict=True))
        # The fastest joint of an iiwa reaches 3.2 rad/s; two measurements differ by noise.
        most = 4.0 * (self._clock.now() - before) + 0.05
        if step > most:
            raise LinkError(
                f"expected joints less than {most:.2g} rad from those before, got "
                f"{step:.2g} rad: an answer was lost, or these are torques"
            )
        self._last = (sent, q)

    def _wait(self, duration: float) -> None:
        self._clock.wait_until(self._clock.now() + duration)
