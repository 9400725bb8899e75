"""A KUKA iiwa behind a KST server, as a `Robot`.

Strictly one answer to one request, in order, each within its time. Whatever else comes (silence,
an answer of another kind, a line that nobody asked for) ends the link for good: which request an
answer belongs to cannot be found out again. Nothing is sent twice, and nobody reconnects. A lost
answer among many of one kind shifts all after it by one; it shows at the next question for torques,
whose answer then comes as joints that no arm can have reached.

What the server's races require is waited for here, so `connect`, `start`, `stop` and `close` take
their time: the server acknowledges a servo before it exists, and then overwrites its target with
the measured joints; and it acknowledges a command before it is ready for the next.

The server has no watchdog. When this program dies or the link breaks, the servo goes on to the last
target, and software can do nothing about it: only the operator can, with the E-stop. So the last
target has to be near, and slow to reach, at any time; a layer above sees to that, and to limits of
position, velocity and acceleration. Here nothing leaves but seven finite numbers.
"""

import socket
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NoReturn

import numpy as np

from equipoise.devices.interfaces import Array, Clock, Reply, Transport
from equipoise.devices.kuka.codec import (
    END,
    GET_JOINTS,
    JOINTS,
    MOVE,
    PORT,
    START_SERVO,
    STOP_SERVO,
    KstLineSplitter,
    expect_done,
    expect_numbers,
    setpoint,
    speed,
)
from equipoise.devices.transports import TcpTransport
from equipoise.errors import LinkError, OutsideError

TIMEOUT: Final = 0.1
"""The answer to a setpoint is overdue after this [s]: a cabled link takes one or two
milliseconds, and a garbage collection on the cabinet tens."""
OUTSTANDING: Final = 20
"""So many setpoints may wait for their answer: 100 ms of a stream at 200 Hz. A run that is stopped
after 50 ms without an answer can still send its way to rest."""
TORQUE_EVERY: Final = 10
"""Number of setpoints of which one asks for external torques: 20 times a second. A reply of the
server has joints or torques, never both."""
REST_TOLERANCE: Final = 1.0
"""The answer to anything else is overdue after this [s]."""
FASTEST: Final = 4.0
"""No joint of an iiwa is faster [rad/s]; the fastest reaches 3.2."""
NOISE: Final = 0.05
"""Between two answers that are read at once measured joints differ by less [rad]."""
APPLICATION: Final = 60.0
"""So long the server waits for its client after it was started on the smartPAD [s]; and so long
`connect` waits for the operator to start it."""
MOTION: Final = 120.0
"""The second acknowledgement of a motion is overdue after this [s]."""
RETRY: Final = 1.0
"""From one attempt to connect to the next [s]."""
AFTER_CONNECT: Final = 1.0
"""Both official clients wait so long before they send anything [s]."""
AFTER_COMMAND: Final = 0.05
"""From an acknowledgement of the server's main thread to the next command [s], as iiwaPy3 has it:
the server clears what came before it had cleared the last."""
AFTER_START: Final = 0.5
"""From the acknowledgement of a servo to the first setpoint [s]: MATLAB's client waits 0.5 s,
iiwaPy3 0.3 s."""
BEFORE_STOP: Final = 0.5
"""From the last setpoint to the stop [s], as MATLAB's client has it."""
AFTER_STOP: Final = 0.3
"""From the acknowledgement of a stop until the servo has surely ended [s], as iiwaPy3 has it."""
AFTER_END: Final = 1.0
"""The server has closed the connection so long after it was asked to [s], or never will."""
POLL: Final = 0.001
"""From one look at the link to the next, while waiting [s]."""
DIAL: Final = 2.0
"""An attempt to connect over TCP may take so long [s]."""

INSTRUCTIONS: Final = (
    "waiting for the robot: start the application MatlabToolboxServer on the smartPAD now; it "
    f"waits {APPLICATION:g} s for its client"
)


def dial(host: str, port: int = PORT) -> Callable[[], Transport]:
    """Return what opens a TCP connection to a KST server, for `KstRobot`."""

    def opened() -> Transport:
        try:
            return TcpTransport(socket.create_connection((host, port), timeout=DIAL))
        except socket.gaierror as error:  # no application on the smartPAD will change that
            raise OutsideError(
                f"there is no host {host} ({error.strerror}); check the name, or give its number, "
                "such as 172.31.1.147"
            ) from None
        except OSError as error:
            raise LinkError(
                f"no connection to {host}, port {port} ({error}); check cable, address and that "
                "the server has been started"
            ) from None

    return opened


class KstRobot:
    """The driver; see the module."""

    def __init__(
        self,
        open_transport: Callable[[], Transport],
        clock: Clock,
        *,
        tell: Callable[[str], None] = lambda _: None,
        attend: Callable[[], None] = lambda: None,
        timeout: float = TIMEOUT,
        outstanding: int = OUTSTANDING,
        patience: float = APPLICATION,
        joints: int = JOINTS,
        torque_every: int = TORQUE_EVERY,
    ) -> None:
        """Prepare; nothing is opened before `connect`.

        Args:
            open_transport: Opens a connection to the server, or raises `LinkError`.
            clock: The rig's.
            tell: Takes what the operator has to know while `connect` waits.
            attend: Called now and then while it waits; what this raises ends the wait.
            timeout: The answer to a setpoint is overdue after this [s].
            outstanding: So many setpoints may wait for their answer.
            patience: `connect` tries so long [s].
            joints: Number of joints; other than seven only in front of an emulated arm.
            torque_every: One setpoint in this number asks for torques.
        """
        self.joints = joints
        """Number of joints, the held one included."""
        self._open, self._clock = open_transport, clock
        self._tell, self._attend = tell, attend
        self._timeout, self._most, self._patience = timeout, outstanding, patience
        self._transport: Transport | None = None
        self._failure = ""
        self._streams, self._sent = False, 0
        self.torque_every = torque_every
        """One setpoint in this number asks for external torques."""
        self._lines = KstLineSplitter()
        self._came: deque[bytes] = deque()
        self._waiting: deque[tuple[float, bool]] = deque()
        self._ready: list[Reply] = []
        self._last: tuple[float, tuple[float, ...]] = (0.0, ())

    def connect(self) -> None:
        """Connect to the server, wait for an operator to start it, and ask it for the joints.

        Raises:
            LinkError: Nobody has started it in time, it says nothing, or something wrong.
        """
        if self._transport is not None or self._failure:
            raise LinkError(
                "a robot is connected to once; for another session start the server again and "
                "make a new connection"
            )
        self._transport = self._reach()
        self._wait(AFTER_CONNECT)
        self.measured()

    def measured(self) -> Array:
        """Ask for the measured joints [rad], shape (7,), while no servo runs.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        self._at_rest("measure")
        return np.array(self._numbers(GET_JOINTS))

    def start(self) -> None:
        """Start the joint servo, and hold the arm where it is.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        self._at_rest("start a servo")
        self._done(START_SERVO)
        self._wait(AFTER_START)
        held = self._numbers(setpoint(self._numbers(GET_JOINTS), joints=self.joints))
        self._streams, self._sent = True, 0
        self._last = (self._clock.now(), held)

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of all joints; each `torque_every`th asks for external torques instead.

        Args:
            q: The joints [rad], shape (7,).

        Raises:
            LinkError: The link is down, no servo runs, or answers are overdue.
            InputError: The setpoint is not seven finite numbers; nothing was sent.
        """
        torque = (self._sent + 1) % self.torque_every == 0
        line = setpoint(q, "external" if torque else "joints", joints=self.joints)
        if not self._streams:
            self._link()
            raise LinkError("the servo does not run, so that no setpoint is obeyed; start it first")
        self._collect()
        if len(self._waiting) >= self._most:
            self._fail(f"{len(self._waiting)} setpoints wait for their answer, expected fewer")
        self._write(line)
        self._sent += 1
        self._waiting.append((self._clock.now(), torque))

    def replies(self) -> list[Reply]:
        """Take the answers that came since the last call, the oldest first.

        Raises:
            LinkError: The link is down, an answer is overdue, or is none.
        """
        self._collect()
        ready, self._ready = self._ready, []
        return ready

    def stop(self) -> None:
        """Stop the servo, the arm at rest; without one, nothing happens.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        self._link()
        if not self._streams:
            return
        while self._waiting:
            self._wait(POLL)
            self._collect()
        self._wait(BEFORE_STOP)
        self._done(STOP_SERVO)
        self._streams = False
        self._wait(AFTER_STOP)

    def move_to(self, q: Sequence[float] | Array, relative_speed: float) -> None:
        """Move to a posture by a motion of the cabinet's own. Blocks until it has ended.

        **Software cannot stop it**, and nothing is sent until it has ended: only the operator can
        stop the arm, at the smartPAD. The server acknowledges twice, and an answer to anything sent
        in between would be taken for the end. The move to home is therefore made of setpoints.

        Args:
            q: Where to [rad], shape (7,).
            relative_speed: Share of the joints' speed limits, above 0 and at most 1.

        Raises:
            LinkError: There is no answer in time, or a wrong one; the server refuses.
            InputError: One of the arguments cannot be sent; nothing was.
        """
        slowed, target = speed(relative_speed), setpoint(q, "done", joints=self.joints)
        self._at_rest("start a motion")
        for command in (slowed, target):
            self._done(command)
            self._wait(AFTER_COMMAND)
        self._done(MOVE)
        expect = f"the end of {_name(MOVE)}"
        self._checked(expect_done, self._receive(expect, MOTION), expect)
        self._wait(AFTER_COMMAND)

    def close(self) -> None:
        """Let the server end, which also ends a servo, and close; an operator has to start it anew.

        Waits for the server to close the connection: one that is closed with bytes unread may take
        the last command with it.
        """
        transport, self._transport = self._transport, None
        if transport is None:
            return
        self._failure = self._failure or "the connection was closed"
        with suppress(LinkError):
            transport.write(END)
            deadline = self._clock.now() + AFTER_END
            while self._clock.now() < deadline:
                transport.read()
                self._wait(POLL)
        transport.close()

    def _reach(self) -> Transport:
        deadline, told = self._clock.now() + self._patience, False
        while True:
            try:
                return self._open()
            except LinkError as error:
                if self._clock.now() >= deadline:
                    raise LinkError(
                        f"no KST server answered within {self._patience:g} s: {error}"
                    ) from None
            if not told:
                self._tell(INSTRUCTIONS)
                told = True
            self._wait(RETRY)
            self._attend()

    def _at_rest(self, what: str) -> None:
        self._link()
        if self._streams:
            raise LinkError(
                f"a servo runs, so that the arm is not at rest to {what}; stop it first"
            )

    def _done(self, command: bytes) -> None:
        self._checked(expect_done, self._ask(command), _name(command))

    def _numbers(self, command: bytes) -> tuple[float, ...]:
        line = self._ask(command)
        try:
            return expect_numbers(line, self.joints, _name(command))
        except LinkError as error:
            self._fail(str(error))

    def _checked(self, check: Callable[[bytes, str], None], line: bytes, command: str) -> None:
        try:
            check(line, command)
        except LinkError as error:
            self._fail(str(error))

    def _ask(self, command: bytes) -> bytes:
        """Send a command that waits for its own answer, when no other does, and return that."""
        self._collect()
        self._write(command)
        return self._receive(f"the answer to {_name(command)}", REST_TOLERANCE)

    def _receive(self, what: str, timeout: float) -> bytes:
        deadline = self._clock.now() + timeout
        while not self._came:
            if self._clock.now() >= deadline:
                self._fail(f"expected {what} within {timeout:g} s, and nothing came")
            self._wait(POLL)
            self._drain()
        return self._came.popleft()

    def _collect(self) -> None:
        """Match what came with the setpoints that wait for it."""
        self._drain()
        now = self._clock.now()
        while self._came:
            line = self._came.popleft()
            if not self._waiting:
                self._fail(f"expected nothing, got {line[:120].decode('latin-1')!r}")
            sent, torque = self._waiting.popleft()
            try:
                values = expect_numbers(line, self.joints, "a setpoint")
            except LinkError as error:
                self._fail(str(error))
            if not torque:
                self._check_step(sent, values)
            self._ready.append(
                Reply(sent, now, None if torque else values, values if torque else None)
            )
        if self._waiting and now - self._waiting[0][0] > self._timeout:
            self._fail(f"expected the answer to a setpoint within {self._timeout:g} s")

    def _check_step(self, sent: float, q: tuple[float, ...]) -> None:
        """Check that the arm can have come to joints [rad] since the answer before."""
        before, q_before = self._last
        step = max(abs(a - b) for a, b in zip(q, q_before, strict=True))
        most = FASTEST * (self._clock.now() - before) + NOISE
        if step > most:
            self._fail(
                f"expected joints less than {most:.2g} rad from those before, got "
                f"{step:.2g} rad: an answer was lost, or these are torques"
            )
        self._last = (sent, q)

    def _drain(self) -> None:
        transport = self._link()
        try:
            self._came.extend(self._lines.feed(transport.read()))
        except LinkError as error:
            self._fail(str(error))

    def _write(self, line: bytes) -> None:
        transport = self._link()
        try:
            transport.write(line)
        except LinkError as error:
            self._fail(str(error))

    def _link(self) -> Transport:
        if self._failure:
            raise LinkError(self._failure)
        if self._transport is None:
            raise LinkError("the robot is not connected; connect first")
        return self._transport

    def _fail(self, why: str) -> NoReturn:
        """End the link for good."""
        self._failure = (
            f"robot: {why}; the link is given up. A servo that runs goes on to the last setpoint, "
            "and software cannot stop it: be ready at the E-stop, and start the server again"
        )
        raise LinkError(self._failure)

    def _wait(self, duration: float) -> None:
        self._clock.wait_until(self._clock.now() + duration)


def _name(command: bytes) -> str:
    """Return the name of a command, for messages."""
    return command.decode().rstrip("\n").split("_")[0]
