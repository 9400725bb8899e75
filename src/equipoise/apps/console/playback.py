"""Time line of a replay: position, shown part, speed and steps, without a browser."""

from typing import Final

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SPEEDS: Final = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}
"""Speeds of a replay, by their labels [-]."""


class Playback:
    """Position in a run that plays, pauses, steps and jumps."""

    def __init__(self, ticks: Floats, whole: tuple[float, float], shown: tuple[float, float]):
        """Begin at the start of the shown part, paused.

        Args:
            ticks: Times of the ticks [s], increasing, shape (n,).
            whole: Start and end of the run [s].
            shown: Start and end of the shown part [s].
        """
        self._ticks, self.whole = ticks, whole
        self.begin, self.end = shown
        """Start and end of the shown part [s]."""
        self.time = self.begin
        """Position [s]."""
        self.speed = 1.0
        """Time of the run per real time [-]."""
        self.playing = False
        """Whether the position moves by itself."""

    def play(self) -> None:
        """Play to the end of the shown part; from its start if the position is at its end."""
        if self.time >= self.end:
            self.time = self.begin
        self.playing = True

    def pause(self) -> None:
        """Keep the position."""
        self.playing = False

    def advance(self, elapsed: float) -> None:
        """Move the position while playing, and pause at the end of the shown part.

        Args:
            elapsed: Real time since the last call [s].
        """
        if not self.playing:
            return
        self.time += self.speed * elapsed
        if self.time >= self.end:
            self.time, self.playing = self.end, False

    def step(self, ticks: int) -> None:
        """Pause, and move to the start of a tick.

        Args:
            ticks: Number of ticks from the one that contains the position; 0 is its start.
        """
        self.playing = False
        now = int(np.searchsorted(self._ticks, self.time + 1e-9, side="right")) - 1
        self.jump(float(self._ticks[min(max(now + ticks, 0), len(self._ticks) - 1)]))

    def jump(self, time: float) -> None:
        """Move to a time, at most to the ends of the run [s]; show more of the run if it has to."""
        self.time = min(max(time, self.whole[0]), self.whole[1])
        self.begin, self.end = min(self.begin, self.time), max(self.end, self.time)

    def show(self, begin: float, end: float) -> None:
        """Change the shown part [s]; the position stays inside it."""
        low, high = self.whole
        self.begin, self.end = (min(max(each, low), high) for each in sorted((begin, end)))
        self.time = min(max(self.time, self.begin), self.end)
