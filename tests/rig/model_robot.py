"""An ideal robot without masses: each setpoint is reached at once, after its transport.

For arms that have no twin, and for tests that need no physics. It obeys any finite setpoint: limits
are a guard's concern.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from equipoise.errors import LinkError
from equipoise.model.arms.arm import Arm
from equipoise.rig.interfaces import Array, Clock, Reply
from equipoise.rig.setpoints import checked

ROUNDING = 1e-9
"""Times so close are equal [s]."""


class ModelRobot:
    """An arm of lines as a `Robot`."""

    def __init__(
        self,
        arm: Arm,
        clock: Clock,
        *,
        transport: float = 0.010,
        round_trip: float = 0.005,
        q: Sequence[float] | Array | None = None,
    ) -> None:
        """Stand an arm at rest.

        Args:
            arm: The arm.
            clock: The rig's clock.
            transport: From sending a setpoint until the arm is there [s].
            round_trip: From sending a setpoint until its reply is there [s]; it tells the joints of
                half-way.
            q: All joints [rad], shape (joints,); home if not given.
        """
        self.joints = len(arm.joints)
        """How many joints there are, the held one included."""
        self._clock = clock
        self._transport, self._round_trip = transport, round_trip
        self._q = np.array(arm.home if q is None else q, np.float64)
        self._coming: deque[tuple[float, Array]] = deque()
        self._asked: deque[float] = deque()
        self._connected = self._streams = False

    def connect(self) -> None:
        """Connect."""
        self._connected = True

    def measured(self) -> Array:
        """Ask for the joints [rad], shape (joints,).

        Raises:
            LinkError: It is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        self._clock.wait_until(self._clock.now() + self._round_trip)
        return self._at(self._clock.now()).copy()

    def start(self) -> None:
        """Let the servo begin, holding the arm where it is.

        Raises:
            LinkError: It is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        self._forget()
        self._streams = True

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of all joints.

        Args:
            q: The joints [rad], shape (joints,).

        Raises:
            LinkError: No servo was started.
            InputError: The setpoint is not one finite number per joint; nothing was sent.
        """
        setpoint = checked(q, self.joints)
        self._check(self._streams, "has no servo running; call start first")
        now = self._clock.now()
        self._coming.append((now + self._transport, setpoint))
        self._asked.append(now)

    def replies(self) -> list[Reply]:
        """Take what came since the last call, the oldest first.

        Raises:
            LinkError: It is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        now, came = self._clock.now(), list[Reply]()
        while self._asked and self._asked[0] + self._round_trip <= now + ROUNDING:
            sent = self._asked.popleft()
            q = tuple(self._at(sent + 0.5 * self._round_trip).tolist())
            nothing = (0.0,) * self.joints
            came.append(
                Reply(
                    sent=sent,
                    received=sent + self._round_trip,
                    q=q,
                    torque=nothing,
                )
            )
        return came

    def stop(self) -> None:
        """Let the servo end, the arm at rest.

        Raises:
            LinkError: It is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        self._forget()

    def close(self) -> None:
        """Say goodbye, which ends the servo."""
        self._forget()
        self._connected = False

    def _forget(self) -> None:
        """Stay where the arm is; what is on its way is lost."""
        self._at(self._clock.now())
        self._coming.clear()
        self._asked.clear()
        self._streams = False

    def _at(self, time: float) -> Array:
        """Return where the arm is at a time that is not before that of the last call [rad]."""
        while self._coming and self._coming[0][0] <= time + ROUNDING:
            self._q = self._coming.popleft()[1]
        return self._q

    def _check(self, good: bool, otherwise: str) -> None:
        if not good:
            raise LinkError(f"the model robot {otherwise}")
