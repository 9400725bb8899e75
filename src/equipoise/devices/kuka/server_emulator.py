"""The KST server as bytes and times, with the real one's faults, in front of any arm.

Two threads share one string in the real server, and so here. The *reader* takes each line; what
sets targets, `getJointsPositions`, pins, stop and end it handles itself. Any other line waits in
that string for the *main* thread, which is deaf while a servo or a motion runs. Hence:

- it acknowledges a command before it clears the string: what comes at once after is erased, so that
  of two main commands in one segment the first alone is answered;
- a servo is acknowledged before it exists, and its target is then overwritten with the measured
  joints; a point-to-point motion is acknowledged twice, and a setpoint in between as ever;
- what arrives for the main thread while a servo runs stays without an answer, and the next line
  erases it; an unknown command is never answered;
- a number that Java cannot read kills the reader (`nan`; but `NaN` becomes the target), after which
  nothing is heard, stop and end included, while the servo goes on; in velocities it ends the servo
  instead, and an eighth velocity hangs the reader, as does a seventh number of a Cartesian target;
- fewer than seven joints change the first ones only; more are ignored;
- nothing watches the client: one that vanishes leaves servo and velocities on, and no other is ever
  served.

Not modelled: a Cartesian servo answers, but the arm holds; Cartesian motions are acknowledged and
then refused; conditional motions (`doPTP!`) are not answered; forces are zero; the velocity servo's
targets go the way of all others; the server does not end when no client comes for 60 s.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from equipoise.devices.kuka.codec import (
    SETPOINTS,
    VELOCITIES,
    Asked,
    KstLineSplitter,
    java_double,
    numbers_reply,
    tokens,
)
from equipoise.devices.kuka.motion import (
    DONE,
    EPSILON,
    NAK,
    ArmBody,
    Mode,
    PtpTask,
    ServerTask,
    ServoTask,
    Targets,
)
from equipoise.errors import InputError, LinkError

PIN: Final = b"1\n\n"
"""Every input of the flange reads as one, and with two line ends."""
CLEARING: Final = 2e-4
"""From an acknowledgement of the main thread until it has cleared its string [s]. The real window
is shorter; only a client that answers at once meets it, and one behind a socket does not."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong on top of what the real server does wrong by itself."""

    delay: float = 0.0
    """Each answer comes so much later [s]."""
    jitter: float = 0.0
    """And up to so much later again, evenly; their order stays [s]."""
    drop: float = 0.0
    """Share of the answers that never come, 0 to 1; what was asked for is done."""
    refuse: float = 0.0
    """Share of the answers that are `nak` instead, 0 to 1."""
    deaf: bool = False
    """Nothing that the client sends arrives, as on a half-open link; the servo goes on."""
    close: bool = False
    """The connection is cut; the servo goes on."""


class KstServer:
    """An emulated KST server for one client: bytes and times in, bytes out.

    Feed what arrives, and advance at least once a millisecond, after the arm has::

        server.feed(data, now)
        for segment in server.advance(now):
            connection.send(segment)
    """

    def __init__(
        self, body: ArmBody, speeds: Sequence[float], *, faults: Faults = Faults(), seed: int = 0
    ) -> None:
        """Begin with a connected client, the arm at rest and no servo.

        Args:
            body: The arm.
            speeds: Limits of its joints' velocities, by which motions go [rad/s], shape (7,); an
                arm with another number of joints gets lines with as many fields.
            faults: What goes wrong besides; it may be replaced at any time.
            seed: Of what is random in the faults.
        """
        self.faults = faults
        self.ended = False
        """Whether the server's program has ended; the connection is closed then."""
        self._body = body
        self._speeds = np.array(speeds, dtype=np.float64)
        self._random = np.random.default_rng(seed)
        self._lines = KstLineSplitter()
        self._hears = True
        self._gone = False
        self._now = 0.0
        self._segments: list[tuple[float, bytes]] = []
        self._targets = Targets(len(speeds))
        self._relative = 0.0
        self._waiting = ""
        self._cleared = 0.0
        self._task: ServerTask | None = None

    @property
    def closed(self) -> bool:
        """Whether the connection is closed from this side."""
        return self.faults.close or (self.ended and not self._segments)

    @property
    def deserted(self) -> bool:
        """Whether the client went without an `end`; no other is ever heard."""
        return self._gone

    @property
    def busy(self) -> bool:
        """Whether a servo or a motion runs, or is about to."""
        return self._task is not None

    def feed(self, data: bytes, now: float) -> None:
        """Take bytes from the client.

        Args:
            data: What has arrived; nothing is no harm.
            now: The time [s].
        """
        self._now = now
        if self.closed or self.faults.deaf or not self._hears:
            return
        try:
            lines = self._lines.feed(data)
        except LinkError:
            self._hears = False
            return
        for line in lines:
            self._read(line)
            if not self._hears:
                return

    def advance(self, now: float) -> list[bytes]:
        """Let the server's threads run.

        Args:
            now: The time [s].

        Returns:
            What leaves for the client by now, segment by segment, in order.
        """
        self._now = now
        if self._task is not None and self._task.step(now):
            if self._task.last_words:
                self._say(self._task.last_words)
                # What came for the main thread meanwhile is erased with its own command.
                self._waiting, self._cleared = "", now + CLEARING
            self._task = None
        if self._task is None and self._waiting and not self.ended:
            waiting, self._waiting = self._waiting, ""
            self._main(waiting)
        due = [segment for time, segment in self._segments if time <= now + EPSILON]
        self._segments = self._segments[len(due) :]
        return due if not (self._gone or self.faults.close) else []

    def vanished(self, now: float) -> None:
        """Notice, unlike the real server, that the client went without an `end`.

        The servo goes on to its last target, or with its last velocity. Nobody is heard again.
        """
        self._now = now
        self._gone, self._hears = True, False

    # The reader's thread.

    def _read(self, line: bytes) -> None:
        self._waiting = ""
        text = line.decode("latin-1")
        try:
            if not self._takes_target(line, text) and not self._answers(line, text):
                self._pass_on(text)
        except InputError:
            self._hears = False

    def _takes_target(self, line: bytes, text: str) -> bool:
        for asked, command in SETPOINTS.items():
            if text.startswith(f"{command}_"):
                try:
                    _put(self._targets.q, tokens(line)[1:])
                finally:  # the servo follows what was read before the reader died
                    if self._task is not None:
                        self._task.taken()
                self._answer(asked)
                return True
        for asked, command in VELOCITIES.items():
            if text.startswith(f"{command}_"):
                self._take_velocity(tokens(line)[1:], len(self._targets.q))
                self._answer(asked)
                return True
        for asked, command in _CARTESIAN.items():
            if text.startswith(f"{command}_"):
                self._take_velocity(tokens(line)[1:], 6, keep=False)
                self._answer(asked)
                return True
        return False

    def _take_velocity(self, fields: list[str], count: int, *, keep: bool = True) -> None:
        """Take velocities, or a Cartesian target that nothing follows."""
        try:
            _put(self._targets.dq if keep else [0.0] * count, fields[:count])
        except InputError:
            self._targets.servo = False
            return
        if len(fields) > count:
            raise InputError("the reader never comes out of its loop over the fields")

    def _answers(self, line: bytes, text: str) -> bool:
        if text.startswith("end"):
            self._targets.servo, self.ended, self._hears = False, True, False
        elif text.startswith("stopDirectServoJoints"):
            self._targets.servo = False
            self._say(DONE)
        elif text.startswith("getJointsPositions"):
            self._answer("joints")
        elif text.startswith("cArtixanPosition"):
            _put([0.0] * 6, tokens(line)[1:])
            self._say(DONE)
        elif text.startswith(_OUTPUTS):
            self._say(DONE)
        elif text.startswith(_INPUTS):
            self._say(PIN)
        else:
            return False
        return True

    def _answer(self, asked: Asked) -> None:
        if asked == "done":
            self._say(DONE)
        elif asked == "joints":
            self._say(numbers_reply(self._body.measured()))
        elif asked in ("external", "measured"):
            self._say(numbers_reply(self._body.torques(asked == "external")))
        elif asked == "pose":
            self._say(numbers_reply(self._body.flange()))
        elif asked == "force":
            self._say(numbers_reply((0.0, 0.0, 0.0)))

    def _pass_on(self, text: str) -> None:
        """Leave a command to the main thread."""
        if self._now < self._cleared - EPSILON:
            return
        if self._task is None:
            self._main(text)
        else:
            self._waiting = text

    def _say(self, answer: bytes) -> None:
        faults = self.faults
        if faults.drop and self._random.random() < faults.drop:
            return
        if faults.refuse and self._random.random() < faults.refuse:
            answer = NAK
        due = self._now + faults.delay
        if faults.jitter:
            due += faults.jitter * self._random.random()
        if self._segments:
            due = max(due, self._segments[-1][0])
        self._segments.append((due, answer))

    # The main thread.

    def _main(self, text: str) -> None:
        fields = [field for field in text.split("_") if field][1:]
        try:
            if text.startswith("TFtrans"):
                self._take_tool(fields)
            elif text.startswith("startDirectServoJoints"):
                self._begin("joints")
            elif text.startswith("stVelDcJoint_"):
                self._begin("velocity")
            elif text.startswith("stDcEEf_"):
                self._begin("held")
            elif text.startswith("startSmartImpedneceJoints"):
                _put([0.0] * len(self._targets.q), fields)
                # Joint 1 keeps the target that it had: the real loop begins with joint 2.
                self._begin("joints", first=1, last_words=DONE)
            elif text.startswith(("handGuiding", "preciseHandGuiding")):
                self._say(DONE)
            elif text.startswith("doPTPinJS"):
                self._say(DONE)
                self._task = self._move()
            elif text.startswith("doPTPinCS"):
                self._say(DONE)
                raise InputError("nothing here plans a Cartesian motion")
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
                return  # it stays in the string, and harms nobody
        except InputError:
            self._say(NAK)
        self._cleared = self._now + CLEARING

    def _take_tool(self, fields: list[str]) -> None:
        _put([0.0] * len(fields), fields)
        if len(fields) > 6:
            raise InputError("a seventh number is out of the bounds of the frame")
        self._say(DONE if len(fields) == 6 else NAK)
        if len(fields) < 6:
            self.ended, self._hears = True, False

    def _begin(self, mode: Mode, *, first: int = 0, last_words: bytes = b"") -> None:
        self._targets.servo = True
        self._say(DONE)
        self._task = ServoTask(
            self._body, self._targets, self._now, mode, first=first, last_words=last_words
        )

    def _move(self) -> PtpTask:
        q, relative = np.array(self._targets.q), self._relative
        if not (0.0 < relative <= 1.0 and np.isfinite(q).all()):
            raise InputError("the motion cannot be planned")
        return PtpTask(self._body, q, relative * self._speeds, self._now)


def _put(into: list[float], fields: list[str]) -> None:
    """Replace the first numbers of a list, up to one that cannot be read."""
    for i, field in enumerate(fields[: len(into)]):
        into[i] = java_double(field)


_CARTESIAN: Final[dict[Asked, str]] = {
    "nothing": "DcSeCar",
    "joints": "DcSeCarJP",
    "external": "DcSeCarExT",
    "measured": "DcSeCarMT",
    "pose": "DcSeCarEEfP",
    "force": "DcSeCarEEfFrelEEF",
}
_END_EFFECTOR: Final[dict[str, Asked]] = {
    "Eef_pos": "pose",
    "Eef_force": "force",
    "Eef_moment": "force",
}
_OUTPUTS: Final = (
    "blueOn",
    "blueOff",
    *(f"pin{number}{state}" for number in (1, 2, 11, 12) for state in ("on", "off")),
)
_INPUTS: Final = tuple(f"getPin{number}" for number in (3, 4, 10, 13, 16))
