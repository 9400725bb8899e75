"""Encoder samples that are missing: one now and then is bridged, more stop a run.

Counts are absolute: what a board counts while a line is lost on its way is in the line after it.
A single sample that is missing therefore hides a millisecond of motion and nothing else. The one
after it still has to be fresh, and where a pendulum can have come to meanwhile
(`equipoise.control.safety`). A link that loses more is not to be relied on.
"""

from math import inf
from typing import Final

OFTEN: Final = 3
"""So many gaps ..."""
WINDOW: Final = 1.0
"""... within this time stop a run [s]."""


class DropoutMonitor:
    """What becomes of the gaps of a run."""

    def __init__(self) -> None:
        """Begin with none."""
        self.bridged = 0
        """How many gaps were let pass."""
        self._times = [-inf] * (OFTEN - 1)
        """When the last ones were, the oldest first [s]."""

    def serious(self, time: float, missing: int) -> int:
        """Return how many missing samples forbid to go on: none where the gap is bridged.

        Args:
            time: When the sample after the gap was counted [s].
            missing: Samples lost before it.
        """
        if missing == 0:
            return 0
        often = not time - self._times[0] > WINDOW
        self._times = [*self._times[1:], time]
        if missing > 1 or often:
            return missing
        self.bridged += 1
        return 0
