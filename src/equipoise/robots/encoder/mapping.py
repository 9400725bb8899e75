"""Conversion of a board's time stamps to the clock of the host.

A line always arrives after its count was taken. The smallest difference between arrival and time
stamp is therefore the best estimate of the zero of the board's clock. The estimate follows a
smaller difference, and otherwise rises by `MAX_CLOCK_ERROR`, so that it also follows a slow clock.
Converted times always increase, and are free of the jitter of arrival.

A line that arrives before its converted time proves that all earlier lines were late. The estimate
then falls by `SLEW`, which keeps rates of the angle correct within a tenth, or by `FAST_SLEW` while
the times are not in use.
"""

from typing import Final

WRAP_US: Final = 2**32
"""Period of the board's clock [us]: 71.6 minutes."""
MAX_CLOCK_ERROR: Final = 1e-3
"""Maximum share by which a board's clock is slow [-]: twenty times the error of a quartz. An Uno's
ceramic resonator can be off by 5e-3, which is not accepted."""
SLEW: Final = 0.1
"""Maximum fall of the estimate per elapsed time [-]; below 1, so that converted times increase."""
FAST_SLEW: Final = 0.9
"""Maximum fall per elapsed time while the times are not in use [-]: 200 ms in 0.22 s."""


class HostTime:
    """Converter from the board's time stamps to the host's clock."""

    def __init__(self, t_us: int, arrival: float) -> None:
        """Create a converter from a first line.

        Args:
            t_us: Time of the count on the board's clock, modulo 2^32 [us].
            arrival: Time of arrival on the host's clock [s].
        """
        self._t_us = t_us
        self._elapsed_us = 0
        self._zero = arrival
        self.lateness = 0.0
        """Delay of the newest line beyond the delay of the fastest lines [s]."""

    def settle(self, t_us: int, arrival: float) -> None:
        """Add a line without using its time: the estimate falls at once."""
        self._advance(t_us)
        self._zero = min(self._zero, arrival - 1e-6 * self._elapsed_us)

    def __call__(self, t_us: int, arrival: float, slew: float = SLEW) -> float:
        """Return the time of a count on the host's clock [s].

        Args:
            t_us: Time of the count on the board's clock, after that of the last line [us].
            arrival: Time of arrival on the host's clock [s].
            slew: Maximum fall of the estimate per elapsed time, below 1 [-].
        """
        passed = self._advance(t_us)
        difference = arrival - 1e-6 * self._elapsed_us
        highest = self._zero + MAX_CLOCK_ERROR * passed
        self._zero = max(min(difference, highest), self._zero - slew * passed)
        self.lateness = max(difference - self._zero, 0.0)
        return self._zero + 1e-6 * self._elapsed_us

    def ahead(self, t_us: int, arrival: float) -> float:
        """Return by how much a line's converted time exceeds its arrival [s]; normally negative."""
        passed_us = (t_us - self._t_us) % WRAP_US
        return self._zero + 1e-6 * (self._elapsed_us + passed_us) - arrival

    def _advance(self, t_us: int) -> float:
        passed = (t_us - self._t_us) % WRAP_US
        self._t_us = t_us
        self._elapsed_us += passed
        return 1e-6 * passed
