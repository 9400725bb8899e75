"""What a rig is made of: a robot, an angle sensor and a clock; and what carries their bytes.

All times are those of the rig's `Clock`, in seconds, from an arbitrary zero; they never go back.
Nothing here blocks but what says so: one thread drains robot and sensor, and sleeps at the clock
only. What fails raises `equipoise.errors.LinkError`, and stays failed: no device resumes by itself.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SETPOINT_PERIOD: Final = 0.005
"""Time between two setpoints [s]: half a tick of 10 ms. KST servers need 200 Hz for a smooth
motion."""


class Reply(NamedTuple):
    """Answer of a robot to one setpoint: measured joints, external torques, or both."""

    sent: float
    """Time at which that setpoint was sent [s]."""
    received: float
    """Time at which the reply was read [s]. The joints count as measured half-way between."""
    q: tuple[float, ...] | None
    """Measured joints [rad], shape (joints,); None in a reply without them."""
    torque: tuple[float, ...] | None
    """External torques [N m], shape (joints,); None in a reply without them. The safety rules need
    them a few times a second, not in each reply."""


class Request(NamedTuple):
    """Request for the next setpoint, by a robot that sets the pace itself."""

    time: float
    """Time of the request [s]."""
    q: tuple[float, ...]
    """Measured joints [rad], shape (joints,)."""
    torque: tuple[float, ...] | None
    """External torques [N m], shape (joints,); None in a request without them."""


class Sample(NamedTuple):
    """One count of the encoder."""

    time: float
    """When it was counted [s]."""
    counts: int
    """Counts since the board was switched on, after x4."""
    pressed: bool
    """Whether the button was pressed since the sample before."""
    illegal: bool
    """Whether the board met a transition of its two lines that cannot be."""
    missing: int
    """Samples lost on the way since the one before."""


@runtime_checkable
class Clock(Protocol):
    """The time of a rig."""

    def now(self) -> float:
        """Return the time [s]."""
        ...

    def wait_until(self, time: float, /) -> None:
        """Block until a time [s], in virtual time by letting the rig run; not if it is past."""
        ...


@runtime_checkable
class Robot(Protocol):
    """An arm that follows a stream of setpoints of all its joints."""

    @property
    def joints(self) -> int:
        """How many joints there are, the held one included."""
        ...

    def connect(self) -> None:
        """Connect, the arm at rest. Blocks, as long as an operator may need to start a server.

        Raises:
            LinkError: There is no answer, or a wrong one.
        """
        ...

    def measured(self) -> Array:
        """Ask for the measured joints [rad], shape (joints,), the servo not running. Blocks.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        ...

    def start(self) -> None:
        """Let the servo begin, holding the arm where it is. Blocks until setpoints are obeyed.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        ...

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of all joints.

        Args:
            q: The joints [rad], shape (joints,).

        Raises:
            LinkError: The link is down, or replies are overdue.
            InputError: The setpoint is not one finite number per joint; nothing was sent.
        """
        ...

    def replies(self) -> list[Reply]:
        """Take what came since the last call, the oldest first.

        Raises:
            LinkError: The link is down, a reply is overdue or is none.
        """
        ...

    def stop(self) -> None:
        """Let the servo end, the arm at rest. Blocks.

        Raises:
            LinkError: There is no answer in time, or a wrong one.
        """
        ...

    def close(self) -> None:
        """Say goodbye, as far as the link allows. Never raises, and may be called again."""
        ...


@runtime_checkable
class PacedRobot(Protocol):
    """An arm that sets the pace: it asks for each setpoint, every few milliseconds.

    `equipoise.devices.paced.PacedStream` makes a `Robot` of it: ticks stay at 10 ms, and each
    request is answered with a point of a smooth path through the setpoints.
    """

    @property
    def joints(self) -> int:
        """Number of joints, the held one included."""
        ...

    def connect(self) -> None:
        """Connect, the arm at rest. Blocks.

        Raises:
            LinkError: There is no answer, or an invalid one.
        """
        ...

    def measured(self) -> Array:
        """Return the measured joints [rad], shape (joints,), while the servo is off. Blocks.

        Raises:
            LinkError: There is no answer in time, or an invalid one.
        """
        ...

    def start(self) -> None:
        """Start the servo, which holds the arm where it is. From now on the robot sends requests.

        Raises:
            LinkError: There is no answer in time, or an invalid one.
        """
        ...

    def request(self, until: float) -> Request | None:
        """Block until the robot asks for a setpoint, or until a time [s].

        Returns:
            The oldest request without an answer; None if there is none at that time.

        Raises:
            LinkError: The link is down, or the robot has stopped.
        """
        ...

    def answer(self, q: Sequence[float] | Array) -> None:
        """Answer the last request with the joints for its next cycle [rad], shape (joints,).

        Raises:
            LinkError: The link is down.
        """
        ...

    def stop(self) -> None:
        """Stop the servo, the arm at rest. Blocks.

        Raises:
            LinkError: There is no answer in time, or an invalid one.
        """
        ...

    def close(self) -> None:
        """Disconnect. Never raises, and may be called again."""
        ...


@runtime_checkable
class AngleSensor(Protocol):
    """An incremental encoder on the pendulum's spindle, with a button."""

    @property
    def description(self) -> str:
        """Name of the device and its properties, for the user."""
        ...

    @property
    def rejected(self) -> int:
        """Number of damaged or inconsistent readings that were dropped since connecting."""
        ...

    @property
    def counts_per_rev(self) -> int:
        """Counts per revolution, after x4; as the board says, where it does."""
        ...

    def connect(self) -> None:
        """Connect and wait for the first sample. Blocks.

        Raises:
            LinkError: There is no sensor, or it says nothing that can be read.
        """
        ...

    def samples(self) -> list[Sample]:
        """Take what came since the last call, the oldest first.

        Raises:
            LinkError: The link is down.
        """
        ...

    def close(self) -> None:
        """Let go of the link. Never raises, and may be called again."""
        ...


@runtime_checkable
class Transport(Protocol):
    """A stream of bytes, both ways."""

    def write(self, data: bytes) -> None:
        """Send bytes; never blocks.

        Raises:
            LinkError: The link is down, or takes no more.
        """
        ...

    def read(self) -> bytes:
        """Return what came since the last call; nothing if nothing did.

        Raises:
            LinkError: The other end is gone.
        """
        ...

    def close(self) -> None:
        """Close; never raises, and may be called again."""
        ...
