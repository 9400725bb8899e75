"""Order and times of a board's lines.

**Order.** The checksum accepts one of 256 badly damaged lines. Each line must therefore also fit
the one before: sequence and time the board's rate, the count the fastest motion of a pendulum.

**Times** on the clock of the host. A line always arrives after its count was taken. The smallest
difference between arrival and time stamp is therefore the best estimate of the zero of the board's
clock. The estimate follows a smaller difference, and otherwise rises by `MAX_CLOCK_ERROR`, so that
it also follows a slow clock. Converted times always increase, and are free of the jitter of
arrival. A line that arrives before its converted time proves that all earlier lines were late. The
estimate then falls by `SLEW`, which keeps rates of the angle correct within a tenth.
"""

from math import ceil, pi
from typing import Final, Literal

from equipoise.robots.encoder.codec import Banner, Reading

MAX_RATE: Final = 40.0
"""Maximum rate of a pendulum [rad/s]. A fall from upright reaches 17 rad/s at w2 = 70 1/s^2, and a
hand may add to it."""
MAX_INCONSISTENT: Final = 5
"""Number of inconsistent lines in a row that is an error; its probability by noise is 256^-5."""
SILENCE: Final = 0.5
"""Time without a line after which the link is down [s]; a run stops on stale counts long before."""
MAX_LATENESS: Final = 0.02
"""Maximum lateness of the fastest line of a second, and maximum time by which a line may arrive
before its converted time [s]."""
WRAP_US: Final = 2**32
"""Period of the board's clock [us]: 71.6 minutes."""
MAX_CLOCK_ERROR: Final = 1e-3
"""Maximum share by which a board's clock is slow [-]: twenty times the error of a quartz. An Uno's
ceramic resonator can be off by 5e-3, which is not accepted."""
SLEW: Final = 0.1
"""Maximum fall of the estimate per elapsed time [-]; below 1, so that converted times increase."""

Inconsistency = Literal["", "time", "count"]
"""Part of a line that does not fit the line before; empty if all parts fit."""


class LineOrder:
    """Order of a board's lines: the last accepted one, and the inconsistent ones since."""

    def __init__(self, banner: Banner) -> None:
        """Start without a line."""
        self._period = 1.0 / banner.rate_hz
        self._counts_per_radian = banner.counts_per_rev / (2.0 * pi)
        self._stride = 0.0
        self.last: Reading | None = None
        """Last accepted line."""
        self.inconsistent = 0
        """Number of inconsistent lines since the last accepted one."""

    def inconsistency(self, line: Reading, ahead: float = 0.0) -> Inconsistency:
        """Return which part of a line is inconsistent with the last one.

        A line that is ahead of its arrival only because lines are missing is forged if it comes
        alone. Several in a row show that earlier lines were late, unless they are ahead by more
        than `SILENCE`: no line is that late.

        Args:
            line: The line.
            ahead: Time by which its converted time exceeds its arrival [s].
        """
        last = self.last or line
        steps = (line.seq - last.seq) % 2**16
        passed = 1e-6 * ((line.t_us - last.t_us) % WRAP_US)
        # Half a period of jitter, and one percent of drift.
        tolerance = 0.5 * self._period + 0.01 * passed
        if steps == 0 or abs(passed - steps * self._period) > tolerance:
            return "time"
        # After a jump the bound does not grow with dropped lines: it would soon allow the jump.
        self._stride = min(self._stride, passed) if self.inconsistent else passed
        # Each end of the motion may be one step off.
        most = ceil(MAX_RATE * self._counts_per_radian * self._stride) + 2
        if abs(signed(line.counts - last.counts)) > most:
            return "count"
        alone = self.inconsistent + 1 < MAX_INCONSISTENT
        leaps = min(ahead, passed) > MAX_LATENESS and (alone or ahead > SILENCE)
        return "time" if leaps else ""

    def drop(self) -> bool:
        """Count an inconsistent line; return whether it is one of too many."""
        self.inconsistent += 1
        return self.inconsistent >= MAX_INCONSISTENT

    def accept(self, line: Reading) -> tuple[int, int]:
        """Accept a line; return the lines missing before it, and the change of the count."""
        last, self.last, self.inconsistent = self.last or line, line, 0
        return (line.seq - last.seq) % 2**16 - 1, signed(line.counts - last.counts)


class HostTime:
    """Converter from the board's time stamps to the host's clock."""

    def __init__(self, t_us: int, arrival: float) -> None:
        """Create a converter from a first line.

        Args:
            t_us: Time of the count on the board's clock, modulo 2^32 [us].
            arrival: Time of arrival on the host's clock [s].
        """
        self._t_us, self._elapsed_us = t_us, 0
        self._zero = arrival
        self.lateness = 0.0
        """Delay of the newest line beyond the delay of the fastest lines [s]."""

    def settle(self, t_us: int, arrival: float) -> None:
        """Add a line without using its time: the estimate falls at once."""
        self._advance(t_us)
        self._zero = min(self._zero, arrival - 1e-6 * self._elapsed_us)

    def __call__(self, t_us: int, arrival: float) -> float:
        """Return the time of a count on the host's clock [s].

        Args:
            t_us: Time of the count on the board's clock, after that of the last line [us].
            arrival: Time of arrival on the host's clock [s].
        """
        passed = self._advance(t_us)
        difference = arrival - 1e-6 * self._elapsed_us
        highest = self._zero + MAX_CLOCK_ERROR * passed
        self._zero = max(min(difference, highest), self._zero - SLEW * passed)
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


def signed(difference: int) -> int:
    """Return the signed difference of 32-bit counts that may have wrapped."""
    return (difference + 2**31) % 2**32 - 2**31
