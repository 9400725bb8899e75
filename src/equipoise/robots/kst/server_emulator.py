"""Emulator of the KST server, as bytes and times, with the real server's faults, for any arm.

As in the real server, two threads share one string. The *reader* receives each line, and handles
targets, `getJointsPositions`, pins, stop and end itself. Any other line waits in that string for
the *main* thread, which ignores it while a servo or a motion runs. Hence:

- The main thread acknowledges a command before it clears the string, which erases a command that
  follows at once: of two main commands in one segment only the first is answered.
- A servo is acknowledged before it exists; its target is then overwritten with the measured joints.
  A point-to-point motion is acknowledged twice, and a setpoint in between as usual.
- A command for the main thread that arrives while a servo runs is not answered, and the next line
  erases it. An unknown command is never answered.
- A number that Java cannot parse (`nan`; but `NaN` becomes the target) kills the reader: all later
  lines are ignored, stop and end included, and the servo continues. In a Cartesian target it ends
  the servo instead, and a seventh number of such a target hangs the reader.
- Fewer than seven joints change the first ones only; further ones are ignored.
- The client is not supervised: if it vanishes, the servo continues, and no other client is ever
  served.

Not modelled: the velocity servo is not answered; a Cartesian servo answers, but the arm holds;
Cartesian motions are acknowledged and then refused; conditional motions (`doPTP!`) are not
answered; forces are zero; the server does not end when no client connects for 60 s.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from equipoise.errors import InputError, LinkError
from equipoise.robots.kst import codec, motion
from equipoise.robots.kst.codec import SETPOINTS, ReplyKind, java_double, tokens
from equipoise.robots.kst.motion import DONE, EPSILON, NAK
from equipoise.worlds.twin.simulated_arm import SimulatedArm

PIN: Final = b"1\n\n"
"""Reply for every input of the flange: one, with two line ends."""
CLEARING_TIME: Final = 2e-4
"""Time from an acknowledgement of the main thread until its string is cleared [s]. The real window
is shorter; only a client that answers at once hits it, and a client behind a socket does not."""


@dataclass(frozen=True)
class Faults:
    """Injected faults, in addition to the faults of the real server."""

    delay: float = 0.0
    """Delay of each reply [s]."""
    jitter: float = 0.0
    """Maximum additional delay, uniformly distributed; replies keep their order [s]."""
    drop: float = 0.0
    """Share of replies that are lost, 0 to 1; their commands are executed."""
    refuse: float = 0.0
    """Share of replies that are `nak` instead, 0 to 1."""
    deaf: bool = False
    """Whether received bytes are dropped, as on a half-open link; the servo continues."""
    close: bool = False
    """Whether the connection is cut; the servo continues."""


class KstServer:
    """An emulated KST server for one client: bytes and times in, bytes out.

    Feed received bytes, and advance at least once a millisecond, after the arm::

        server.feed(data, now)
        for segment in server.advance(now):
            connection.send(segment)
    """

    def __init__(
        self,
        body: SimulatedArm,
        speeds: Sequence[float],
        *,
        faults: Faults = Faults(),
        seed: int = 0,
    ) -> None:
        """Begin with a connected client, the arm at rest and no servo.

        Args:
            body: The arm.
            speeds: Velocity limits of the joints, which scale motions [rad/s], shape (7,); for an
                arm with another number of joints, lines have as many fields.
            faults: Injected faults; may be replaced at any time.
            seed: Seed of random faults.
        """
        self.faults = faults
        self.ended = False
        """Whether the server's program has ended; the connection is closed then."""
        self.deserted = False
        """Whether the client left without an `end`; no other is ever served."""
        self._body = body
        self._speeds = np.array(speeds, dtype=np.float64)
        self._random = np.random.default_rng(seed)
        self._lines = codec.KstLineSplitter()
        self._reads = True
        self._segments: list[tuple[float, bytes]] = []
        self._targets = motion.Targets(len(speeds))
        self._now = self._cleared = self._relative = 0.0
        self._waiting = ""
        self._task: motion.ServerTask | None = None

    @property
    def closed(self) -> bool:
        """Whether the connection is closed from this side."""
        return self.faults.close or (self.ended and not self._segments)

    @property
    def busy(self) -> bool:
        """Whether a servo or a motion runs or is starting."""
        return self._task is not None

    def feed(self, data: bytes, now: float) -> None:
        """Receive bytes from the client.

        Args:
            data: Received bytes; may be empty.
            now: The time [s].
        """
        self._now = now
        if self.closed or self.faults.deaf or not self._reads:
            return
        try:
            for line in self._lines.feed(data):
                if self._reads:
                    self._read(line)
        except LinkError:
            self._reads = False

    def advance(self, now: float) -> list[bytes]:
        """Run the server's threads until a time.

        Args:
            now: The time [s].

        Returns:
            Segments sent to the client by now, in order.
        """
        self._now = now
        if self._task is not None and self._task.step(now):
            if self._task.final_reply:
                self._say(self._task.final_reply)
                # Commands received meanwhile are erased with the task's own command.
                self._waiting, self._cleared = "", now + CLEARING_TIME
            self._task = None
        if self._task is None and self._waiting and not self.ended:
            waiting, self._waiting = self._waiting, ""
            self._main(waiting)
        due = [segment for time, segment in self._segments if time <= now + EPSILON]
        self._segments = self._segments[len(due) :]
        return due if not (self.deserted or self.faults.close) else []

    def vanished(self, now: float) -> None:
        """Record, unlike the real server, that the client left without an `end`.

        The servo continues to its last target. No line is read again.
        """
        self._now, self.deserted, self._reads = now, True, False

    # The reader's thread.

    def _read(self, line: bytes) -> None:
        self._waiting = ""
        text = line.decode("latin-1")
        try:
            if not self._takes_target(line, text) and not self._answers(line, text):
                self._pass_on(text)
        except InputError:
            self._reads = False

    def _takes_target(self, line: bytes, text: str) -> bool:
        command, separator, _ = text.partition("_")
        if not separator or command not in _TARGETS:
            return False
        commands, reply = _TARGETS[command]
        fields = tokens(line)[1:]
        if commands is SETPOINTS:
            try:
                _put(self._targets.q, fields)
            finally:  # the servo follows the numbers read before the reader died
                if self._task is not None:
                    self._task.taken()
        else:
            self._take_cartesian(fields)
        self._answer(reply)
        return True

    def _take_cartesian(self, fields: list[str]) -> None:
        """Check a Cartesian target; no servo follows it."""
        try:
            _put([0.0] * 6, fields)
        except InputError:
            self._targets.servo = False
            return
        if len(fields) > 6:
            raise InputError("the reader never comes out of its loop over the fields")

    def _answers(self, line: bytes, text: str) -> bool:
        if text.startswith("end"):
            self._targets.servo, self.ended, self._reads = False, True, False
        elif text.startswith(_ACKNOWLEDGED):
            if text.startswith("stopDirectServoJoints"):
                self._targets.servo = False
            elif text.startswith("cArtixanPosition"):
                _put([0.0] * 6, tokens(line)[1:])
            self._say(DONE)
        elif text.startswith("getJointsPositions"):
            self._answer("joints")
        elif text.startswith(_INPUTS):
            self._say(PIN)
        else:
            return False
        return True

    def _answer(self, kind: ReplyKind) -> None:
        if kind == "done":
            self._say(DONE)
        elif kind == "joints":
            self._say(codec.numbers_reply(self._body.measured()))
        elif kind in ("external", "measured"):
            self._say(codec.numbers_reply(self._body.torques(kind == "external")))
        elif kind == "pose":
            self._say(codec.numbers_reply(self._body.flange()))
        elif kind == "force":
            self._say(codec.numbers_reply((0.0, 0.0, 0.0)))

    def _pass_on(self, text: str) -> None:
        """Pass a command to the main thread."""
        if self._now < self._cleared - EPSILON:
            return
        if self._task is None:
            self._main(text)
        else:
            self._waiting = text

    def _say(self, reply: bytes) -> None:
        faults = self.faults
        if faults.drop and self._random.random() < faults.drop:
            return
        if faults.refuse and self._random.random() < faults.refuse:
            reply = NAK
        due = self._now + faults.delay
        if faults.jitter:
            due += faults.jitter * self._random.random()
        if self._segments:
            due = max(due, self._segments[-1][0])
        self._segments.append((due, reply))

    # The main thread.

    def _main(self, text: str) -> None:
        fields = tokens(text.encode("latin-1"))[1:]
        try:
            if text.startswith("TFtrans"):
                self._take_tool(fields)
            elif text.startswith("startDirectServoJoints"):
                self._begin("joints")
            elif text.startswith("stDcEEf_"):
                self._begin("held")
            elif text.startswith("startSmartImpedneceJoints"):
                _put([0.0] * len(self._targets.q), fields)
                # Joint 1 keeps its old target: the real loop begins with joint 2.
                self._begin("joints", first=1, final_reply=DONE)
            elif text.startswith(("handGuiding", "preciseHandGuiding")):
                self._say(DONE)
            elif text.startswith("doPTPinJS"):
                self._say(DONE)
                self._task = self._move()
            elif text.startswith("doPTPinCS"):
                self._say(DONE)
                raise InputError("Cartesian motions are not planned")
            elif text.startswith("jRelVel"):
                self._relative = java_double(fields[0] if fields else "jRelVel")
                self._say(DONE)
            elif text.startswith("Torques_ext_J"):
                self._answer("external")
            elif text.startswith("Torques_m_J"):
                self._answer("measured")
            elif text in _END_EFFECTOR:
                self._answer(_END_EFFECTOR[text])
            else:
                return  # it stays in the string, without effect
        except InputError:
            self._say(NAK)
        self._cleared = self._now + CLEARING_TIME

    def _take_tool(self, fields: list[str]) -> None:
        _put([0.0] * len(fields), fields)
        if len(fields) > 6:
            raise InputError("a seventh number is out of the bounds of the frame")
        self._say(DONE if len(fields) == 6 else NAK)
        if len(fields) < 6:
            self.ended, self._reads = True, False

    def _begin(self, mode: motion.Mode, first: int = 0, final_reply: bytes = b"") -> None:
        self._targets.servo = True
        self._say(DONE)
        task = motion.ServoTask(self._body, self._targets, self._now, mode, first, final_reply)
        self._task = task

    def _move(self) -> motion.PtpTask:
        q, relative = np.array(self._targets.q), self._relative
        if not (0.0 < relative <= 1.0 and np.isfinite(q).all()):
            raise InputError("the motion cannot be planned")
        return motion.PtpTask(self._body, q, relative * self._speeds, self._now)


def _put(into: list[float], fields: list[str]) -> None:
    """Replace the first numbers of a list, up to the first invalid field."""
    for i, field in enumerate(fields[: len(into)]):
        into[i] = java_double(field)


_CARTESIAN: Final[dict[ReplyKind, str]] = {
    **{kind: f"DcSeCar{suffix}" for kind, suffix in codec.SUFFIXES.items() if suffix},
    "nothing": "DcSeCar",
}
_TARGETS: Final[dict[str, tuple[dict[ReplyKind, str], ReplyKind]]] = {
    command: (commands, kind)
    for commands in (SETPOINTS, _CARTESIAN)
    for kind, command in commands.items()
}
"""Table and reply of each command that sets a target, by its name."""
_END_EFFECTOR: Final[dict[str, ReplyKind]] = {
    "Eef_pos": "pose",
    "Eef_force": "force",
    "Eef_moment": "force",
}
_ACKNOWLEDGED: Final = (
    *("stopDirectServoJoints", "cArtixanPosition", "blueOn", "blueOff"),
    *(f"pin{number}{state}" for number in (1, 2, 11, 12) for state in ("on", "off")),
)
_INPUTS: Final = tuple(f"getPin{number}" for number in (3, 4, 10, 13, 16))
