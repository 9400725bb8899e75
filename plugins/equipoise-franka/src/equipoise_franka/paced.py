r"""A driver that is asked for each command, as a `Robot` with setpoints of half a tick.

The controller requests a command every millisecond, on its own clock; ticks last 10 ms and give a
setpoint each 5 ms. Each request is answered from a quadratic B-spline over the setpoints
:math:`q_k`: from the middle of :math:`q_{k-1} q_k` to the middle of :math:`q_k q_{k+1}`, with
:math:`0 \le s < 1` over one period T,

.. math:: 2 q(s) = (1 - s)^2 q_{k-1} + (1 + 2 s - 2 s^2) q_k + s^2 q_{k+1}

Its velocity runs linearly from :math:`(q_k - q_{k-1}) / T` to :math:`(q_{k+1} - q_k) / T`, and its
acceleration is :math:`(q_{k+1} - 2 q_k + q_{k-1}) / T^2`. These are the differences that the guard
checks (`equipoise.rig.guarded`). While setpoints come in time, no point between them is
therefore further out, faster or more accelerated than the checked setpoints. The price is a
constant delay of T / 2 + `MARGIN`, which an identification of the arm contains.

Requests are answered while the loop waits for its clock: the stream is the clock of its rig, too.
"""

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import Final, NoReturn

import numpy as np

from equipoise.arrays import Array
from equipoise.errors import LinkError
from equipoise.rig.interfaces import SETPOINT_PERIOD, Clock, Reply, checked_setpoint
from equipoise.safety.rules import FIRST_LIMIT
from equipoise_franka.robot import FrankaRobot

MARGIN: Final = 0.001
"""Lateness of a setpoint that does not change the path [s]; a tick computes for 0.3 ms."""
LATE_FRACTION: Final = 0.5
"""Maximum further lateness of a setpoint that still bends the present part of the path, as a
fraction of a period [-]. The path then jumps by at most half its square of the step to that
setpoint. A later setpoint waits for the next part, before which the arm comes to rest."""
SILENCE: Final = 0.1
"""Time without a request after which the link is lost [s]; a stall of 70 ms is bridged."""


class PacedStream:
    """A driver of requests and answers as a `Robot`, and as the clock of its rig."""

    def __init__(self, robot: FrankaRobot, clock: Clock, period: float = SETPOINT_PERIOD) -> None:
        """Create the stream of a driver.

        Args:
            robot: The driver.
            clock: Clock of the loop.
            period: Time between two setpoints [s].
        """
        self._robot, self._clock, self._period = robot, clock, period
        self._failure, self._asked = "", -inf
        self._streams = False
        self._held = True
        self._begin = -inf
        self._knots: deque[Array] = deque(maxlen=3)
        self._ahead: deque[Array] = deque()
        self._sent: deque[float] = deque()
        self._replies: list[Reply] = []

    @property
    def joints(self) -> int:
        """Number of joints, the held one included."""
        return self._robot.joints

    # The clock.

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Answer the robot's requests until a time [s].

        Raises:
            LinkError: The link is down, or the robot has stopped, or it was not at rest where it
                was measured at the start.
        """
        while self._streams and (request := self._robot.request(time)) is not None:
            away = np.abs(np.subtract(request.q, self._knots[2])).max()
            if self._begin == -inf and not away <= FIRST_LIMIT:  # NaN fails, too
                self._fail(
                    f"the robot was measured {away:.2g} rad from its posture at the start, "
                    f"expected at most {FIRST_LIMIT:g} rad: a reply is wrong, or the arm moves"
                )
            self._robot.answer(self._at(request.time))
            received = self._asked = self._clock.now()
            while self._sent and self._sent[0] <= request.time:
                sent = self._sent.popleft()
                self._replies.append(Reply(sent, received, request.q, request.torque))
        self._clock.wait_until(time)

    # The robot.

    def connect(self) -> None:
        """Connect.

        Raises:
            LinkError: The reply is missing or invalid.
        """
        self._robot.connect()

    def measured(self) -> Array:
        """Return the measured joints [rad], shape (joints,), while the servo is off.

        Raises:
            LinkError: The reply is late or invalid, or the stream has failed.
        """
        if self._failure:
            raise LinkError(self._failure)
        return self._robot.measured()

    def start(self) -> Array:
        """Start the servo, which holds the arm at its position.

        Returns:
            The joints where it is held [rad], shape (joints,). The requests have to agree until the
            first setpoint: a single reply may be wrong.

        Raises:
            LinkError: The reply is late or invalid.
        """
        held = self.measured()
        self._robot.start()
        self._knots.extend([held] * 3)
        for queue in (self._ahead, self._sent, self._replies):
            queue.clear()
        self._begin, self._held, self._asked = -inf, True, self._clock.now()
        self._streams = True
        return held

    def send(self, q: Sequence[float] | Array) -> None:
        """Add a setpoint of all joints to the path.

        Args:
            q: The joints [rad], shape (joints,).

        Raises:
            LinkError: No servo runs, or the robot is silent.
            InputError: The setpoint is not one finite number per joint; it was not added.
        """
        setpoint = checked_setpoint(q, self.joints)
        if not self._streams:
            raise LinkError(self._failure or "the robot has no servo running; call start first")
        now = self._clock.now()
        if now - self._asked > SILENCE:
            self._fail(f"the robot has requested nothing for {1e3 * SILENCE:g} ms")
        self._advance(now)
        since = now - self._begin
        if self._held and since >= self._period:  # the path stands still, and begins anew
            self._knots.extend([self._knots[2]] * 3)
            self._begin = now + MARGIN - self._period
        if self._held and since <= LATE_FRACTION * self._period:
            self._knots[2], self._held = setpoint, False  # bends the present part
        else:
            self._ahead.append(setpoint)
        self._sent.append(now)

    def replies(self) -> list[Reply]:
        """Return the replies since the last call, the oldest first.

        A reply has the joints of the first request after its setpoint.
        """
        replies, self._replies = self._replies, []
        return replies

    def stop(self) -> None:
        """Stop the servo, the arm at rest.

        Raises:
            LinkError: The reply is late or invalid.
        """
        self._streams = False
        self._robot.stop()

    def close(self) -> None:
        """Disconnect."""
        self._streams = False
        self._robot.close()

    def _fail(self, why: str) -> NoReturn:
        """Give up the stream for good; the robot stops without answers."""
        self._failure = why
        self._streams = False
        raise LinkError(why)

    # The path.

    def _advance(self, time: float) -> None:
        """Advance to the part of the path at a time [s]."""
        while time >= self._begin + self._period and not (self._held and not self._ahead):
            self._held = not self._ahead
            self._knots.append(self._knots[2] if self._held else self._ahead.popleft())
            self._begin += self._period

    def _at(self, time: float) -> Array:
        """Return the path at a time [rad]; without new setpoints it rests at the last one."""
        self._advance(time)
        s = min(max((time - self._begin) / self._period, 0.0), 1.0)
        a, b, c = self._knots
        return 0.5 * ((1.0 - s) ** 2 * a + (1.0 + 2.0 * s - 2.0 * s * s) * b + s * s * c)
