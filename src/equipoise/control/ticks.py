"""Inputs and outputs of a control tick of a run on a rig (`equipoise.rig.run_controller`)."""

from collections.abc import Sequence
from math import ceil
from typing import Final, NamedTuple

import numpy as np

from equipoise.outcomes import End

OK: Final = "ok"
"""Answer that Enter gives, and the pendulum's button."""


class Sample(NamedTuple):
    """One count of the encoder."""

    time: float
    """Time of the count [s]."""
    counts: int
    """Counts since the board was switched on, after x4, growing with theta."""
    pressed: bool
    """Whether the button was pressed since the sample before."""
    illegal: bool
    """Whether the board detected an illegal transition of its two lines."""
    missing: int
    """Number of samples lost since the one before."""


class Reply(NamedTuple):
    """Answer of a robot to one setpoint: measured joints, external torques, or both."""

    sent: float
    """Time at which that setpoint was sent [s]."""
    received: float
    """Time at which the reply was read [s]. The joints count as measured half-way between."""
    q: tuple[float, ...] | None
    """Measured joints [rad], shape (joints,); None in a reply without them. The safety rules use
    those of round trips up to 17.5 ms, and stop the run without any for 120 ms."""
    torque: tuple[float, ...] | None
    """External torques [N m], shape (joints,); None in a reply without them. The safety rules need
    them a few times a second, not in each reply."""


class OperatorMessage(NamedTuple):
    """Message to the operator."""

    name: str
    """Name of the new state or of the question, one word."""
    text: str = ""
    """Sentence for the operator."""
    answers: tuple[str, ...] = ()
    """Expected answers; empty for a message that needs none."""
    time: float = np.nan
    """Time on the run's clock [s]; NaN until it is logged."""


class TickRecord(NamedTuple):
    """Observation and decision of a tick, for the log; NaN outside the balance.

    Each field is a column of the log, which `equipoise.log.columns` describes.
    """

    x: float = np.nan
    x_dot: float = np.nan
    phi: float = np.nan
    phi_dot: float = np.nan
    box: int = -1
    u: float = 0.0
    estimated_phi: float = np.nan
    estimated_phi_dot: float = np.nan
    bias: float = 0.0
    estimated_x_dot: float = np.nan
    estimated_x: float = np.nan


class TickOutput(NamedTuple):
    """Output of a tick."""

    setpoints: tuple[Sequence[float], ...]
    """All joints now, and h / 2 later [rad]; empty while nothing is to be sent."""
    q: Sequence[float]
    """Commanded joints at the end of the tick [rad]."""
    dq: Sequence[float]
    """Their velocities [rad/s]."""
    state: int
    """Index of the phase of the run."""
    record: TickRecord
    """Record for the log."""
    events: Sequence[OperatorMessage]
    """Messages for the operator and the log."""
    to_rest: bool = False
    """Whether the setpoints lead to rest, so that the arm need not be stopped."""
    done: bool = False
    """Whether the arm is at rest and the run is over; the setpoints are sent."""


class TickInputs(NamedTuple):
    """Inputs since the last tick."""

    samples: Sequence[Sample]
    """Samples of the encoder."""
    replies: Sequence[Reply]
    """Replies of the robot."""
    lines: Sequence[str]
    """Lines typed by the operator."""
    faults: Sequence[End]
    """Failures that stop the run: the encoder's link, a setpoint held back."""
    lateness: float
    """Lateness of the tick [s]. A loop that stood still skips the ticks that it missed, and begins
    again at the time of a later one: the lateness is then whole ticks, to half a tick."""
    unsent: bool = False
    """Whether the second setpoint of the tick before was not sent, because the loop stalled."""

    def paused(self, h: float) -> bool:
        """Return whether the arm has come to rest at the last setpoint sent: the loop stalled.

        Args:
            h: Time between ticks [s].
        """
        return self.unsent or missed_ticks(self.lateness, h) > 0


def missed_ticks(lateness: float, h: float) -> int:
    """Return the number of ticks that a late loop skips.

    Later than half a tick, the tick's second setpoint is due: the loop waits for the next tick.

    Args:
        lateness: Lateness of the tick that was due [s].
        h: Time between ticks [s].
    """
    return ceil(lateness / h - 0.5)
