"""Interfaces of a rig: robot, angle sensor, clock, operator, and the transport of bytes.

All times are those of the rig's `Clock` [s], from an arbitrary zero, and never decrease. Methods do
not block unless their docstring says so: one thread reads robot and sensor, and waits at the clock
only. A device that fails raises `equipoise.errors.LinkError`, and never resumes by itself.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Final, Protocol, runtime_checkable

import numpy as np

from equipoise.arrays import Array
from equipoise.control.ticks import OperatorMessage, Reply, Sample
from equipoise.errors import InputError

SETPOINT_PERIOD: Final = 0.005
"""Time between two setpoints [s]: half a tick of 10 ms."""


class Clock(Protocol):
    """Time of a rig."""

    def now(self) -> float:
        """Return the time [s]."""
        ...

    def wait_until(self, time: float, /) -> None:
        """Block until a time [s], or return at once if it is past; virtual time runs the rig."""


@runtime_checkable
class Robot(Protocol):
    """An arm that follows a stream of setpoints of all its joints.

    After `start` it obeys them; while none comes it goes to the last one, and rests there.
    """

    @property
    def joints(self) -> int:
        """Number of joints, the held one included."""
        ...

    def connect(self) -> None:
        """Connect, the arm at rest. Blocks, if needed until an operator has made the robot ready.

        Raises:
            LinkError: The reply is missing or invalid.
        """

    def measured(self) -> Array:
        """Return the measured joints [rad], shape (joints,), while the servo is off. Blocks.

        It is called 50 times a second while the operator is asked, so that a lost link is noticed.

        Raises:
            LinkError: The reply is late or invalid.
        """
        ...

    def start(self) -> Array:
        """Start the servo, which holds the arm at its position. Blocks until it runs.

        It sends no setpoint that a single reply says: that reply may be wrong.

        Returns:
            The joints measured after that [rad], shape (joints,).

        Raises:
            LinkError: The reply is late or invalid.
        """
        ...

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of all joints.

        Args:
            q: The joints [rad], shape (joints,).

        Raises:
            LinkError: The link is down, no servo runs, or replies are overdue.
            InputError: The setpoint is not one finite number per joint; nothing was sent.
        """

    def replies(self) -> list[Reply]:
        """Return the replies since the last call, the oldest first.

        Raises:
            LinkError: The link is down, or a reply is overdue or invalid.
        """
        ...

    def stop(self) -> None:
        """Stop the servo, the arm at rest. Blocks.

        Raises:
            LinkError: The reply is late or invalid.
        """

    def close(self) -> None:
        """Disconnect; a failing link is ignored. Never raises, and may be called again."""


@runtime_checkable
class AngleSensor(Protocol):
    """An incremental encoder on the pendulum's spindle, with a button."""

    @property
    def rejected(self) -> int:
        """Number of damaged or inconsistent readings that were dropped since connecting."""
        ...

    @property
    def counts_per_rev(self) -> int:
        """Counts per revolution, after x4; from the board, if it reports them."""
        ...

    def connect(self) -> None:
        """Connect and wait for the first sample. Blocks.

        Raises:
            LinkError: The sensor is missing, or sends nothing valid.
        """

    def samples(self) -> list[Sample]:
        """Return the samples since the last call, the oldest first.

        Raises:
            LinkError: The link is down, or silent.
        """
        ...

    def close(self) -> None:
        """Close the link. Never raises, and may be called again."""


class Transport(Protocol):
    """A stream of bytes, both ways."""

    def write(self, data: bytes) -> None:
        """Send bytes; never blocks.

        Raises:
            LinkError: The link is down, or accepts no more bytes.
        """

    def read(self) -> bytes:
        """Return the bytes since the last call; empty without any.

        Raises:
            LinkError: The other end has closed the link.
        """
        ...

    def close(self) -> None:
        """Close; never raises, and may be called again."""


class Operator(Protocol):
    """Person, program or emulation that supervises a run."""

    def notify(self, event: OperatorMessage) -> None:
        """Receive a message; never blocks."""
        ...

    def read_input(self) -> list[str]:
        """Return the lines typed since the last call, the oldest first; never blocks."""
        ...


def checked_setpoint(q: Sequence[float] | Array, joints: int) -> Array:
    """Validate a setpoint, and return a copy as an array [rad], shape (joints,).

    Args:
        q: The setpoint [rad].
        joints: Number of joints.

    Raises:
        InputError: The setpoint is not one finite number per joint.
    """
    with suppress(TypeError, ValueError, OverflowError):
        setpoint = np.array(q, np.float64)
        if setpoint.shape == (joints,) and np.isfinite(setpoint).all():
            return setpoint
    raise InputError(
        f"a setpoint is {joints} finite numbers, one for each joint, not {str(q)[:120]}; "
        "nothing was sent"
    )
