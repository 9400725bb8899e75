"""A guard around any robot: the last thing that a setpoint passes before it becomes bytes.

Each is checked by the rules of `equipoise.control.safety`. One that may not be sent is held back,
for good: from then on the guard sends a ramp to rest of its own, from what was sent last, whatever
it is given. It never clips, and never lets anything through again.
"""

from collections.abc import Iterator, Sequence

from equipoise.control.safety import Limits, check_first, check_setpoint
from equipoise.control.stop import Ramp, ramp
from equipoise.devices.interfaces import Array, Reply, Robot
from equipoise.errors import LinkError


class GuardedRobot:
    """A `Robot` that sends nothing but what may be sent, and stops by itself otherwise."""

    def __init__(self, robot: Robot, limits: Limits, period: float) -> None:
        """Guard a robot.

        Args:
            robot: The robot.
            limits: What setpoints have to keep to.
            period: Time between two of them [s].
        """
        self._robot, self._limits, self._period = robot, limits, period
        self._measured: tuple[float, ...] = ()
        self._last: tuple[float, ...] | None = None
        self._before: tuple[float, ...] = ()
        self._ramp: Ramp | None = None
        self._sent = 0  # of the ramp
        self.held_back: str | None = None
        """Why a setpoint was not sent; none while all are."""

    @property
    def joints(self) -> int:
        """How many joints there are."""
        return self._robot.joints

    @property
    def at_rest(self) -> bool:
        """Whether the guard's own ramp, if there is one, is at its end."""
        return self._ramp is None or self._sent * self._period >= self._ramp.duration

    @property
    def started_at(self) -> tuple[float, ...]:
        """Where the arm was measured when the servo began [rad]; the first setpoint is there."""
        return self._measured

    @property
    def last(self) -> tuple[float, ...] | None:
        """The setpoint that was sent last [rad]; none before the first."""
        return self._last

    def connect(self) -> None:
        """Connect.

        Raises:
            LinkError: There is no answer, or a wrong one.
        """
        self._robot.connect()

    def measured(self) -> Array:
        """Ask for the measured joints [rad], shape (joints,).

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        return self._robot.measured()

    def start(self) -> None:
        """Let the servo begin; the first setpoint has to be where the arm is measured now.

        Raises:
            LinkError: There is no answer in time, or a wrong one; or this guard has stopped.
        """
        if self.held_back is not None:
            raise LinkError(f"the guard has stopped ({self.held_back}); begin a new run")
        self._measured = tuple(self._robot.measured().tolist())
        self._last = None
        self._robot.start()

    def send(self, q: Sequence[float] | Array, *, to_rest: bool = False) -> None:
        """Send a setpoint, or, where it may not be sent, the next one of a ramp to rest.

        Args:
            q: The joints [rad], shape (joints,).
            to_rest: It is on a way to rest that ends inside the limits: it is not asked where the
                arm could be stopped.

        Raises:
            LinkError: The link is down, replies are overdue; or nothing was sent yet and the first
                setpoint is not where the arm is.
        """
        if self._ramp is None:
            setpoint = tuple(map(float, q))
            last, before = self._last, self._before
            if last is None:
                broken = check_first(self._limits, setpoint, self._measured)
                if broken is not None:
                    self.held_back = broken.reason
                    raise LinkError(f"nothing was sent: {broken.reason}")
                before = setpoint
            else:
                broken = check_setpoint(self._limits, setpoint, last, before, self._period, to_rest)
            if broken is None:
                self._robot.send(setpoint)
                self._before = setpoint if last is None else last
                self._last = setpoint
                return
            self.held_back = broken.reason
            self._begin_ramp()
        self._robot.send(self._next())

    def replies(self) -> list[Reply]:
        """Take what came since the last call, the oldest first.

        Raises:
            LinkError: The link is down, a reply is overdue or is none.
        """
        return self._robot.replies()

    def stop(self) -> None:
        """Let the servo end, the arm at rest.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        self._robot.stop()

    def close(self) -> None:
        """Say goodbye."""
        self._robot.close()

    def rest(self) -> Iterator[tuple[float, ...]]:
        """Yield the setpoints of a way to rest from what was sent last, to be sent one a period."""
        if self._last is None:
            return
        if self._ramp is None:
            self._begin_ramp()
        if self.at_rest:
            return
        while not self.at_rest:
            yield self._upcoming
        yield self._upcoming  # the same again: with it nothing moves any more

    def _begin_ramp(self) -> None:
        last = self._last
        if last is None:
            return
        dq = [(b - a) / self._period for a, b in zip(self._before, last, strict=True)]
        # How fast the flange goes is not known here: the joints alone decide.
        self._ramp, self._sent = ramp(last, dq, 0.0, self._limits), 0

    @property
    def _upcoming(self) -> tuple[float, ...]:
        assert self._ramp is not None  # noqa: S101 - its only callers have begun it
        return self._ramp.at((self._sent + 1) * self._period)

    def _next(self) -> tuple[float, ...]:
        self._before, self._last = self._last or (), self._upcoming
        self._sent += 1
        return self._last
