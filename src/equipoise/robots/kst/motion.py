"""Tasks of the emulated KST server's main thread: servos and point-to-point motions.

Both send targets to the arm behind the server, a `SimulatedArm`, which follows them by the
cabinet's servo law. A task begins when its command is acknowledged, and is stepped at least once a
millisecond until it ends.
"""

from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from equipoise.robots.kst.codec import JOINTS
from equipoise.worlds.twin.simulated_arm import SimulatedArm

Array = npt.NDArray[np.float64]

DONE: Final = b"done\n"
"""Acknowledgement of the server."""
NAK: Final = b"nak\n"
"""Reply of the server after an error in its main thread."""

SERVO_START: Final = 5e-3
"""Time from the acknowledgement until a servo exists [s]: "a few milliseconds"."""
SERVO_STOP: Final = 3e-3
"""Time from the acknowledgement of a stop until the servo has ended [s]: "a few milliseconds"."""
MIN_MOVE_TIME: Final = 20e-3
"""Minimum time between the two acknowledgements of a motion [s]; a client that receives both at
once waits for ever for the second."""
REACHED: Final = 1e-3
"""Maximum distance of a joint from the end of a finished motion [rad]: the servo's shaping takes a
third of a second for the last milliradian."""
SERVO_TIMEOUT: Final = 0.5
"""Timeout of the arm after the end of the path [s]."""
SAG: Final = 5e-3
"""Maximum distance of a resting joint from the end of a successful motion [rad]: drives without
load data and integral term hold an arm a few milliradians lower."""
PEAK: Final = 1.875
"""Peak speed of a minimum-jerk path, relative to its mean speed [-]."""
EPSILON: Final = 1e-9
"""Rounding of times [s]."""


class Targets:
    """Targets that the server's reader writes and its servo reads."""

    def __init__(self, joints: int = JOINTS) -> None:
        """Start with zeros and no servo, as the server does."""
        self.q = [0.0] * joints
        """Target of the joint servo and of the next motion [rad]."""
        self.servo = False
        """Whether a servo is requested."""


class ServerTask:
    """Task of the server's main thread."""

    final_reply = b""
    """Reply to the client at the end of the task; empty for no reply."""

    def taken(self) -> None:
        """Receive a new joint target; ignored by default."""

    def step(self, now: float) -> bool:
        """Run until a time [s], and return whether the task has ended."""
        raise NotImplementedError


Mode = Literal["joints", "held"]
"""Input of a servo: the joint target, or nothing."""


class ServoTask(ServerTask):
    """Servo from its acknowledgement to its end; runs on without a client."""

    def __init__(
        self, body: SimulatedArm, targets: Targets, now: float, mode: Mode, first: int, final: bytes
    ) -> None:
        """Schedule the start.

        Args:
            body: The arm.
            targets: Targets from the reader.
            now: Time of the acknowledgement [s].
            mode: Input of the servo.
            first: First joint whose target the measured joint replaces at the start.
            final: Reply to the client at the end.
        """
        self.final_reply = final
        self._body, self._targets, self._mode, self._first = body, targets, mode, first
        self._begins = now + SERVO_START
        self._ends: float | None = None
        self._runs = False

    def taken(self) -> None:
        """Pass a new joint target to the arm; before the servo exists it is dropped."""
        if self._runs and self._mode == "joints":
            self._body.target(tuple(self._targets.q))

    def step(self, now: float) -> bool:
        """Start and stop when due."""
        if not self._runs:
            if now < self._begins - EPSILON:
                return False
            self._runs = True
            self._begin()
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
        if self._mode == "joints":
            measured = [float(q) for q in self._body.measured()]
            self._targets.q[self._first :] = measured[self._first :]
            self.taken()


class PtpTask(ServerTask):
    """Point-to-point motion along a minimum-jerk path; no command of a client stops it."""

    def __init__(self, body: SimulatedArm, q: Array, speeds: Array, now: float) -> None:
        """Start the motion.

        Args:
            body: The arm.
            q: Goal [rad], shape (7,).
            speeds: Maximum joint speeds [rad/s], shape (7,).
            now: Time of the acknowledgement [s].
        """
        self._body, self._begins = body, now
        self._from, self._to = np.array(body.measured(), dtype=np.float64), q
        fastest = float(np.max(PEAK * np.abs(q - self._from) / speeds))
        self._duration = max(fastest, MIN_MOVE_TIME)
        body.servo(True)

    def step(self, now: float) -> bool:
        """Move the target along the path, then wait for the arm."""
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
        self.final_reply = DONE if missing <= SAG else NAK
        return True
