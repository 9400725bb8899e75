"""Guard around any robot: the last check of each setpoint before it is sent.

The guard checks each setpoint by the rules of `equipoise.safety.rules`. It holds back an invalid
setpoint and all later ones, and sends its own ramp to rest instead, which starts at the last
setpoint sent with its velocity. It never clips a setpoint.
"""

from collections import deque
from collections.abc import Sequence
from math import ceil

from equipoise.arrays import Array
from equipoise.errors import LinkError
from equipoise.outcomes import End, describe
from equipoise.rig.interfaces import Robot
from equipoise.safety.rules import Limits, check_first, check_setpoint
from equipoise.safety.stop import ramp


class GuardedRobot:
    """Robot that is sent valid setpoints only, and otherwise stopped."""

    def __init__(self, robot: Robot, limits: Limits, period: float) -> None:
        """Guard a robot.

        Args:
            robot: The robot.
            limits: Limits of setpoints.
            period: Time between two setpoints [s].
        """
        self._limits, self._period = limits, period
        self.robot = robot
        """The robot, for all but its start and its setpoints."""
        self.started_at: tuple[float, ...] = ()
        """Measured joints after the start of the servo [rad], equal to the first setpoint."""
        self.last: tuple[float, ...] | None = None
        """Last setpoint sent [rad]; None before the first."""
        self._before: tuple[float, ...] = ()
        """Setpoint before the last one [rad]; the same where the arm rests."""
        self._ramp: deque[tuple[float, ...]] | None = None
        """Setpoints of the ramp to rest that are still to be sent; None before a stop."""
        self.held_back: End | None = None
        """Broken rule of a setpoint that was held back; None without one."""

    @property
    def at_rest(self) -> bool:
        """Whether the guard's ramp has ended or was never started."""
        return not self._ramp

    def start(self) -> None:
        """Start the servo; the first setpoint has to equal the joints measured after that.

        Raises:
            LinkError: A reply is late or invalid, this guard has stopped, or the joints before and
                after the start differ or are outside the limits: a reply is wrong, or the arm
                moves.
        """
        if self.held_back is not None:
            raise LinkError(f"the guard has stopped ({describe(self.held_back)}); begin a new run")
        before = self.robot.measured().tolist()
        self.last, self.started_at = None, tuple(self.robot.start().tolist())
        self._refuse(check_first(self._limits, self.started_at, before))

    def send(
        self, q: Sequence[float] | Array, *, to_rest: bool = False, from_rest: bool = False
    ) -> None:
        """Send a setpoint, or the next one of a ramp to rest if the setpoint is invalid.

        Args:
            q: The joints [rad], shape (joints,).
            to_rest: Whether the setpoint belongs to a ramp to rest inside the limits, so that the
                stopping distance is not checked.
            from_rest: Whether the arm has come to rest at the last setpoint, because the stream
                stood still.

        Raises:
            LinkError: The link is down, replies are overdue, or the first setpoint differs from the
                measured joints.
        """
        if self._ramp is None:
            setpoint, last = tuple(map(float, q)), self.last
            if last is None:
                last = setpoint
                self._refuse(check_first(self._limits, setpoint, self.started_at))
            else:
                if from_rest:
                    self._before = last
                path = setpoint, last, self._before
                if broken := check_setpoint(self._limits, *path, self._period, to_rest):
                    self.held_back = broken
                    self.stop()
            if self._ramp is None:
                self.robot.send(setpoint)
                self._before, self.last = last, setpoint
                return
        if self._ramp:
            self.last = self._ramp.popleft()
        self.robot.send(self.last or ())

    def stop(self) -> None:
        """Begin a ramp to rest from the last setpoint sent; it replaces all later setpoints."""
        if self.last is None or self._ramp is not None:
            return
        dq = [(b - a) / self._period for a, b in zip(self._before, self.last, strict=True)]
        # The flange speed is not known here: the joints alone determine the ramp.
        way = ramp(self.last, dq, 0.0, self._limits)
        number = ceil(way.duration / self._period)
        self._ramp = deque(way.at(k * self._period).q for k in range(1, number + 1))
        if self._ramp:  # repeated, so that the arm no longer moves
            self._ramp.append(self._ramp[-1])

    def _refuse(self, broken: End | None) -> None:
        """Refuse to send anything where a rule is broken before the first setpoint."""
        if broken is not None:
            self.held_back = broken
            raise LinkError(f"nothing was sent: {describe(broken)}")
