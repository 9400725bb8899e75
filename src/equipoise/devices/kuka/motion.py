"""What keeps the main thread of the emulated KST server busy: servos and point-to-point motions.

Both hand targets to a `ArmBody`, the arm behind the server, which follows them by the cabinet's own
servo law. Either begins when its command is acknowledged, and is stepped at least once a
millisecond until it is over.
"""

from collections.abc import Sequence
from typing import Final, Literal, Protocol

import numpy as np
import numpy.typing as npt

from equipoise.devices.kuka.codec import JOINTS

Array = npt.NDArray[np.float64]

DONE: Final = b"done\n"
"""The server's acknowledgement."""
NAK: Final = b"nak\n"
"""What it answers where its main thread met an error."""

SERVO_START: Final = 5e-3
"""From the acknowledgement until a servo exists [s]: "a few milliseconds"."""
SERVO_STOP: Final = 3e-3
"""From the acknowledgement of a stop until the servo has ended [s]: likewise."""
SHORTEST_MOVE: Final = 20e-3
"""The second acknowledgement of a motion comes so much later than the first, at least [s]; a client
that receives both at once waits for ever for the second."""
REACHED: Final = 1e-3
"""A motion has ended when no joint is further from its end than this [rad]: the servo's shaping
takes a third of a second for the rest of a milliradian."""
SERVO_TIMEOUT: Final = 0.5
"""So long after the end of its path a motion waits for the arm to reach that [s]."""
SAG: Final = 5e-3
"""Where an arm rests short of its end by no more, the motion has succeeded, too [rad]: drives that
do not know their load, and have no integral term, hold it a few milliradians lower."""
PEAK: Final = 1.875
"""Peak speed of a minimum-jerk path over its mean speed."""
EPSILON: Final = 1e-9
"""Rounding of times [s]."""


class ArmBody(Protocol):
    """The arm behind an emulated server."""

    def measured(self) -> Sequence[float]:
        """Return the measured joints [rad], all seven."""
        ...

    def torques(self, external: bool) -> Sequence[float]:
        """Return the external or the measured torques of the seven joints [N m]."""
        ...

    def flange(self) -> Sequence[float]:
        """Return the flange's x, y, z [mm] and a, b, c [rad]."""
        ...

    def servo(self, running: bool) -> None:
        """Let the servo begin, holding the arm where it is, or end."""
        ...

    def target(self, q: Sequence[float]) -> None:
        """Take the servo's newest target [rad]; NaN where a client sent it."""
        ...


class Targets:
    """What the server's reader writes and its servo reads."""

    def __init__(self, joints: int = JOINTS) -> None:
        """Begin with zeros and no servo, as the server does."""
        self.q = [0.0] * joints
        """Target of the joint servo and of the next motion [rad]."""
        self.dq = [0.0] * joints
        """Velocity of the velocity servo [rad/s]."""
        self.servo = False
        """Whether a servo shall run."""


class ServerTask(Protocol):
    """What keeps the main thread busy."""

    @property
    def last_words(self) -> bytes:
        """What the client is told when it is over; nothing if empty."""
        ...

    def taken(self) -> None:
        """Notice a new target."""
        ...

    def step(self, now: float) -> bool:
        """Go on until a time [s], and return whether it is over."""
        ...


Mode = Literal["joints", "velocity", "held"]
"""What a servo follows: the joint target, the integral of the velocities, or nothing."""


class ServoTask:
    """A servo from its acknowledgement to its end, whoever has gone meanwhile."""

    def __init__(
        self,
        body: ArmBody,
        targets: Targets,
        now: float,
        mode: Mode,
        *,
        first: int = 0,
        last_words: bytes = b"",
    ) -> None:
        """Be about to begin.

        Args:
            body: The arm.
            targets: What the reader writes.
            now: When the start is acknowledged [s].
            mode: What it follows.
            first: From this joint on, measured joints replace the target when the servo begins.
            last_words: What the client is told when it has ended.
        """
        self.last_words = last_words
        self._body, self._targets, self._mode, self._first = body, targets, mode, first
        self._begins = now + SERVO_START
        self._ends: float | None = None
        self._runs = False
        self._time = 0.0
        self._q: list[float] = []
        self._dq = [0.0] * len(targets.q)

    def taken(self) -> None:
        """Pass a new joint target on; before the servo exists nobody takes it."""
        if self._runs and self._mode == "joints":
            self._body.target(tuple(self._targets.q))

    def step(self, now: float) -> bool:
        """Begin, integrate velocities and end, when it is time."""
        if not self._runs:
            if now < self._begins - EPSILON:
                return False
            self._runs, self._time = True, now
            self._begin()
        if self._mode == "velocity":
            self._integrate(now)
        if self._targets.servo:
            return False
        if self._ends is None:
            self._ends = now + SERVO_STOP
        if now < self._ends - EPSILON:
            return False
        self._body.servo(False)
        return True

    def _begin(self) -> None:
        self._body.servo(True)
        self._q = [float(q) for q in self._body.measured()]
        if self._mode == "velocity":
            self._targets.dq[:] = self._dq
        elif self._mode == "joints":
            self._targets.q[self._first :] = self._q[self._first :]
            self.taken()

    def _integrate(self, now: float) -> None:
        """Move the target by the mean of old and new velocity."""
        half, self._time = 0.5 * (now - self._time), now
        dq = list(self._targets.dq)
        self._q = [q + half * (a + b) for q, a, b in zip(self._q, self._dq, dq, strict=True)]
        self._dq = dq
        self._body.target(tuple(self._q))


class PtpTask:
    """A point-to-point motion along a minimum-jerk path; nothing that a client says stops it."""

    def __init__(self, body: ArmBody, q: Array, speeds: Array, now: float) -> None:
        """Begin.

        Args:
            body: The arm.
            q: Where to [rad], shape (7,).
            speeds: What no joint exceeds [rad/s], shape (7,).
            now: When the start is acknowledged [s].
        """
        self.last_words = b""
        self._body, self._begins = body, now
        self._from, self._to = np.array(body.measured(), dtype=np.float64), q
        fastest = float(np.max(PEAK * np.abs(q - self._from) / speeds))
        self._duration = max(fastest, SHORTEST_MOVE)
        body.servo(True)

    def taken(self) -> None:
        """Keep to the target of the beginning."""

    def step(self, now: float) -> bool:
        """Move the target along the path; at its end wait for the arm."""
        s = min((now - self._begins) / self._duration, 1.0)
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        self._body.target(tuple((self._from + share * (self._to - self._from)).tolist()))
        late = now - self._begins - self._duration
        if late < -EPSILON:
            return False
        error = np.asarray(self._body.measured()) - self._to
        missing = float(np.max(np.abs(error)))
        if missing > REACHED and late < SERVO_TIMEOUT:
            return False
        self._body.servo(False)
        self.last_words = DONE if missing <= SAG else NAK
        return True
