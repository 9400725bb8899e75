"""Driver of the velocity servo of a KST server, a `Robot`.

The joint servo of the server shapes each step towards a setpoint; its velocity servo does not. It
integrates the last velocity it was sent, for ever: if this program dies, the arm moves on. The
driver therefore belongs behind a guard (`equipoise.devices.kuka.velocity_guard`).

Setpoints are joints, as for every robot. The velocity of a setpoint is its step over the time
between two setpoints, plus a slow correction of the difference between the setpoint and the joints
that the server has integrated to, as the driver expects them from its own send times. These drift
from the server's by the jitter of the link; measured joints correct the expectation.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from equipoise.devices.interfaces import SETPOINT_PERIOD, Array
from equipoise.devices.kuka import codec
from equipoise.devices.kuka.robot import AFTER_START, KstRobot

CORRECTION_TIME: Final = 0.05
"""Time constant with which a joint returns to its setpoints [s]."""
MAX_CORRECTION: Final = 0.05
"""Largest velocity of that correction [rad/s]: its onset is half of the velocity change that a
joint's acceleration allows between two setpoints."""
DRIFT_TIME: Final = 2.0
"""Time constant with which measured joints correct the expected ones [s]: long beside a period of
the motion, in which they lag behind."""
RESPONSE: Final = 3
"""Number of setpoints by which measured joints lag behind the integral: 15 ms."""


class KstVelocityRobot(KstRobot):
    """Driver of the velocity servo; see the module."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Create the driver, with the arguments of `KstRobot`."""
        super().__init__(*arguments, **options)
        self._setpoint = self._expected = self._velocity = np.zeros(self.joints)
        self._since = 0.0
        self._history = deque[Array]()

    def stop(self) -> None:
        """Stop the servo, the arm at rest; without a servo, do nothing.

        Raises:
            LinkError: A reply is late or invalid.
        """
        streams = self._streams
        if streams:
            self.send(self._setpoint)  # a setpoint that does not change has no velocity
        super().stop()
        if streams:
            self._ready.pop()  # its reply, for which nobody asked

    def _start_servo(self) -> tuple[float, ...]:
        self._done(codec.START_VELOCITY_SERVO)
        self._wait(AFTER_START)
        held = self._numbers(codec.velocity(np.zeros(self.joints), joints=self.joints))
        self._setpoint, self._velocity = np.array(held), np.zeros(self.joints)
        self._expected, self._since = self._setpoint.copy(), self._clock.now()
        self._history = deque([self._expected.copy()] * RESPONSE)
        return held

    def _command(self, q: Sequence[float] | Array, reply: codec.ReplyKind) -> bytes:
        now = self._clock.now()
        self._expected += (now - self._since) * self._velocity
        self._since = now
        self._history.append(self._expected.copy())
        step = np.asarray(q, np.float64) - self._setpoint
        correction = (self._setpoint - self._expected) / CORRECTION_TIME
        np.clip(correction, -MAX_CORRECTION, MAX_CORRECTION, out=correction)
        # A joint at rest stays at rest: nothing moves while this program is silent.
        self._velocity = np.where(step != 0.0, step / SETPOINT_PERIOD + correction, 0.0)
        self._setpoint = self._setpoint + step
        return codec.velocity(self._velocity, reply, joints=self.joints)

    def _take_up(self, q: tuple[float, ...] | None) -> None:
        then = self._history.popleft()
        if q is not None:
            self._expected += SETPOINT_PERIOD / DRIFT_TIME * (np.array(q) - then)
