"""Disturbances that repeat: a rare single one is bridged, several within a second stop a run.

They are the dropouts of encoder samples, and the stalls of the loop and of the robot's link while
the arm moves. Each stall makes the arm stop and start again; no single limit shows that it happens
often.
"""

from math import inf
from typing import Final

MAX_REPEATS: Final = 3
"""Number of disturbances within `REPEAT_WINDOW` that stops a run."""
REPEAT_WINDOW: Final = 1.0
"""Window for counting disturbances [s]."""


class RepeatMonitor:
    """Monitor of the disturbances of one kind in a run."""

    def __init__(self) -> None:
        """Start without a disturbance."""
        self._times = [-inf] * (MAX_REPEATS - 1)
        """Times of the last disturbances, the oldest first [s]."""

    def add(self, time: float) -> bool:
        """Add a disturbance at a time [s]; return whether it is one too many."""
        often = not time - self._times[0] > REPEAT_WINDOW
        self._times = [*self._times[1:], time]
        return often
