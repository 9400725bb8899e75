"""Emulator of the KST server's joint servo, as bytes and times, with the real server's faults.

As in the real server, two threads share one string. The *reader* receives each line, and handles
targets, `getJointsPositions`, stop and end itself. Any other line waits in that string for the
*main* thread, which ignores it while a servo runs. Hence:

- A servo is acknowledged before it exists; its target is then overwritten with the measured joints.
- A command for the main thread that arrives while a servo runs is not answered, and the next line
  erases it. An unknown command is never answered.
- A number that Java cannot parse (`nan`; but `NaN` becomes the target) kills the reader: all later
  lines are ignored, stop and end included, and the servo continues.
- Fewer than seven joints change the first ones only; further ones are ignored.
- The client is not supervised: if it vanishes, the servo continues, and no other client is ever
  served.

Not modelled: Cartesian, impedance and velocity servos, point-to-point motions, tools, pins and
forces, which are not answered; the server does not end when no client connects for 60 s.
"""

from typing import Final

from equipoise.errors import InputError, LinkError
from equipoise.robots.kst import codec
from equipoise.robots.kst.codec import SETPOINTS, ReplyKind, java_double, tokens
from equipoise.worlds.twin.simulated_arm import SimulatedArm

DONE: Final = b"done\n"
"""Acknowledgement of the server."""
SERVO_START: Final = 5e-3
"""Time from the acknowledgement until a servo exists [s]: "a few milliseconds"."""
SERVO_STOP: Final = 3e-3
"""Time from the acknowledgement of a stop until the servo has ended [s]: "a few milliseconds"."""
EPSILON: Final = 1e-9
"""Rounding of times [s]."""
_KINDS: Final[dict[str, ReplyKind]] = {command: kind for kind, command in SETPOINTS.items()}


class KstServer:
    """An emulated KST server for one client: bytes and times in, bytes out.

    Faults beyond those of the real server are attributes that may be set at any time. Feed received
    bytes, and advance at least once a millisecond, after the arm::

        server.feed(data, now)
        for segment in server.advance(now):
            connection.send(segment)
    """

    def __init__(self, body: SimulatedArm, joints: int = codec.JOINTS) -> None:
        """Begin with a connected client, the arm at rest and no servo.

        Args:
            body: The arm.
            joints: Number of joints; lines have as many fields.
        """
        self.drops = self.refuses = False
        """Whether replies are lost, or `nak`: faults; their commands are executed."""
        self.deaf = False
        """Whether received bytes are dropped, as on a half-open link: a fault."""
        self.cut = False
        """Whether the connection is cut: a fault; the servo continues."""
        self.ended = False
        """Whether the server's program has ended; the connection is closed then."""
        self.deserted = False
        """Whether the client left without an `end`; no other is ever served."""
        self._body, self._target = body, [0.0] * joints
        self._own_reading = body.measured  # of the servo, which no fault of a reply reaches
        self._lines = codec.KstLineSplitter()
        self._reads = True
        self._segments: list[bytes] = []
        self._now = 0.0
        self._waiting = ""
        self._starts: float | None = None  # of the servo; None without one
        self._stops: float | None = None
        self._requested = self._runs = False

    @property
    def closed(self) -> bool:
        """Whether the connection is closed from this side."""
        return self.cut or (self.ended and not self._segments)

    @property
    def busy(self) -> bool:
        """Whether a servo runs or is starting."""
        return self._starts is not None

    def feed(self, data: bytes, now: float) -> None:
        """Receive bytes from the client.

        Args:
            data: Received bytes; may be empty.
            now: The time [s].
        """
        self._now = now
        if self.closed or self.deaf or not self._reads:
            return
        try:
            for line in self._lines.feed(data):
                if self._reads:
                    self._read(line)
        except (InputError, LinkError):
            self._reads = False

    def advance(self, now: float) -> list[bytes]:
        """Run the server's threads until a time.

        Args:
            now: The time [s].

        Returns:
            Segments sent to the client since the last call, in order.
        """
        self._now = now
        self._step_servo()
        if not self.busy and self._waiting and not self.ended:
            waiting, self._waiting = self._waiting, ""
            self._main(waiting)
        segments, self._segments = self._segments, []
        return [] if self.deserted or self.cut else segments

    def vanished(self, now: float) -> None:
        """Record, unlike the real server, that the client left without an `end`.

        The servo continues to its last target. No line is read again.
        """
        self._now, self.deserted, self._reads = now, True, False

    # The reader's thread.

    def _read(self, line: bytes) -> None:
        """Obey a line.

        Raises:
            InputError: The line kills the reader.
        """
        self._waiting = ""
        command, separator, _ = line.decode("latin-1").partition("_")
        if separator and command in _KINDS:
            try:
                for i, field in enumerate(tokens(line)[1 : len(self._target) + 1]):
                    self._target[i] = java_double(field)
            finally:  # the servo follows the numbers read before the reader died
                if self._runs:
                    self._body.target(tuple(self._target))
            self._answer(_KINDS[command])
        elif command.startswith("end"):
            self._requested, self.ended, self._reads = False, True, False
        elif command.startswith("stopDirectServoJoints"):
            self._requested = False
            self._say(DONE)
        elif command.startswith("getJointsPositions"):
            self._answer("joints")
        elif self.busy:
            self._waiting = command
        else:
            self._main(command)

    def _answer(self, kind: ReplyKind) -> None:
        body = self._body
        values = body.measured() if kind == "joints" else body.torques(external=True)
        self._say(DONE if kind == "done" else codec.numbers_reply(values))

    def _say(self, reply: bytes) -> None:
        if not self.drops:
            self._segments.append(b"nak\n" if self.refuses else reply)

    # The main thread.

    def _main(self, command: str) -> None:
        if command.startswith("startDirectServoJoints"):
            self._requested = True
            self._say(DONE)
            self._starts, self._stops = self._now + SERVO_START, None

    def _step_servo(self) -> None:
        """Start and stop the servo when due; it runs on without a client."""
        if self._starts is None:
            return
        if not self._runs:
            if self._now < self._starts - EPSILON:
                return
            self._runs = True
            self._body.servo(True)
            self._target[:] = [float(q) for q in self._own_reading()]
            self._body.target(tuple(self._target))
        if self._requested:
            return
        if self._stops is None:
            self._stops = self._now + SERVO_STOP
        if self._now >= self._stops - EPSILON:
            self._body.servo(False)
            self._starts, self._runs = None, False
