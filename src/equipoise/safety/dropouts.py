"""Dropouts of encoder samples: a rare single one is bridged, more stop a run.

Counts are absolute: the line after a lost one contains its motion. A single missing sample
therefore hides a millisecond of motion and nothing else. The sample after it still has to be fresh
and plausible (`equipoise.safety.rules`). A link that loses more is not reliable.
"""

from math import inf
from typing import Final

MAX_DROPOUTS: Final = 3
"""Number of dropouts within `DROPOUT_WINDOW` that stops a run."""
DROPOUT_WINDOW: Final = 1.0
"""Window for counting dropouts [s]."""


class DropoutMonitor:
    """Monitor of the dropouts of a run."""

    def __init__(self) -> None:
        """Start without dropouts."""
        self.bridged = 0
        """Number of dropouts bridged."""
        self._times = [-inf] * (MAX_DROPOUTS - 1)
        """Times of the last dropouts, the oldest first [s]."""

    def serious(self, time: float, missing: int) -> int:
        """Return the number of missing samples that stops the run; 0 for a bridged dropout.

        Args:
            time: Time of the sample after the dropout [s].
            missing: Number of samples lost before it.
        """
        if missing == 0:
            return 0
        often = not time - self._times[0] > DROPOUT_WINDOW
        self._times = [*self._times[1:], time]
        if missing > 1 or often:
            return missing
        self.bridged += 1
        return 0
