"""What a rig is made of: a robot, an angle sensor and a clock; and what carries their bytes.

All times are those of the rig's `Clock`, in seconds, from an arbitrary zero; they never go back.
Nothing here blocks but what says so: one thread drains robot and sensor, and sleeps at the clock
only. What fails raises `equipoise.errors.LinkError`, and stays failed: no device resumes by itself.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Reply(NamedTuple):
    """What a robot said to one setpoint."""

    sent: float
    """When that setpoint was sent [s]."""
    received: float
    """When the reply was read [s]."""
    q: tuple[float, ...] | None
    """Measured joints [rad], all of them; none where torques were asked for instead."""
    torque: tuple[float, ...] | None
    """External torques [N m], where they were asked for."""


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

    def send(self, q: Sequence[float] | Array, *, torque: bool = False) -> None:
        """Send a setpoint of all joints [rad].

        Args:
            q: The joints, shape (joints,).
            torque: Ask for external torques instead of measured joints.

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
class AngleSensor(Protocol):
    """An incremental encoder on the pendulum's spindle, with a button."""

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
