"""The time of a board on the clock of the host.

A line arrives some time after its count was taken, never before: the smallest difference between
the host's time of arrival and the board's time of counting is the best guess at where the board's
zero lies. The guess follows a smaller difference, and otherwise rises by `SLOWEST`, so that it also
follows a board whose clock is slow. Times given out always increase, and no jitter of arrival is
in them.

A line that arrives before the time that the guess gives it proves that all lines before came late.
The guess then falls at `SLEW`, which keeps rates of the angle right within a tenth, or at
`FAST_FALL_TIME` while nothing depends on them.
"""

from typing import Final

WRAP_US: Final = 2**32
"""The board's clock is a whole number of microseconds modulo this: 71.6 minutes."""
SLOWEST: Final = 1e-3
"""A board's clock may be slower than the host's by this share: twenty times what a quartz is off.
The ceramic resonator of an Uno can be off by 5e-3, and will not do."""
SLEW: Final = 0.1
"""The guess falls by at most this share of the time that passes, so that no time goes back."""
HURRY: Final = 0.9
"""Largest such share while nothing depends on the times: 200 ms are made up for in 0.22 s."""


class HostTime:
    """Maps the board's time stamps to the host's clock."""

    def __init__(self, t_us: int, arrival: float) -> None:
        """Begin with a first line.

        Args:
            t_us: The board's clock when it took the count, modulo 2^32 [us].
            arrival: The host's when it read the line [s].
        """
        self._t_us = t_us
        self._elapsed_us = 0
        self._zero = arrival
        self.lateness = 0.0
        """From the newest count to its arrival, beyond the fastest lines' [s]."""

    def settle(self, t_us: int, arrival: float) -> None:
        """Take a line whose time is not given out: the guess falls at once."""
        self._advance(t_us)
        self._zero = min(self._zero, arrival - 1e-6 * self._elapsed_us)

    def __call__(self, t_us: int, arrival: float, slew: float = SLEW) -> float:
        """Return when a count was taken on the host's clock [s].

        Args:
            t_us: The board's clock when it took the count, later than the line's before [us].
            arrival: The host's when it read the line [s].
            slew: Largest share of the time that passes by which the guess may fall, below 1.
        """
        passed = self._advance(t_us)
        difference = arrival - 1e-6 * self._elapsed_us
        highest = self._zero + SLOWEST * passed
        self._zero = max(min(difference, highest), self._zero - slew * passed)
        self.lateness = max(difference - self._zero, 0.0)
        return self._zero + 1e-6 * self._elapsed_us

    def ahead(self, t_us: int, arrival: float) -> float:
        """Return how far a line would lie after its own arrival [s]; negative for a true one."""
        passed_us = (t_us - self._t_us) % WRAP_US
        return self._zero + 1e-6 * (self._elapsed_us + passed_us) - arrival

    def _advance(self, t_us: int) -> float:
        passed = (t_us - self._t_us) % WRAP_US
        self._t_us = t_us
        self._elapsed_us += passed
        return 1e-6 * passed
