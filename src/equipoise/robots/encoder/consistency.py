"""Consistency of a board's lines: each with the one before, and with the fastest pendulum.

The checksum accepts one of 256 badly damaged lines. Each line must therefore also fit the one
before: sequence and time the board's rate, the count the fastest motion of a pendulum.
"""

from math import ceil, pi
from typing import Final, Literal

from equipoise.robots.encoder.codec import Banner, Reading
from equipoise.robots.encoder.mapping import WRAP_US

MAX_RATE: Final = 40.0
"""Maximum rate of a pendulum [rad/s]. A fall from upright reaches 17 rad/s at w2 = 70 1/s^2, and a
hand may add to it."""
SLACK_COUNTS: Final = 2
"""Tolerance of the difference of two counts: one step at each end."""
JITTER: Final = 0.5
"""Tolerance of a line's time stamp relative to its sequence, as a share of a period [-]."""
DRIFT: Final = 0.01
"""Additional tolerance, as a share of the time since the line before [-]."""
MAX_INCONSISTENT: Final = 5
"""Number of inconsistent lines in a row that is an error; its probability by noise is 256^-5."""
SILENCE: Final = 0.5
"""Time without a line after which the link is down [s]; a run stops on stale counts long before."""
MAX_LATENESS: Final = 0.02
"""Maximum lateness of the fastest line of a second, and maximum time by which a line may arrive
before its converted time [s]."""

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
        if (
            steps == 0
            or abs(passed - steps * self._period) > JITTER * self._period + DRIFT * passed
        ):
            return "time"
        # After a jump the bound does not grow with dropped lines: it would soon allow the jump.
        self._stride = min(self._stride, passed) if self.inconsistent else passed
        most = ceil(MAX_RATE * self._counts_per_radian * self._stride) + SLACK_COUNTS
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


def signed(difference: int) -> int:
    """Return the signed difference of 32-bit counts that may have wrapped."""
    return (difference + 2**31) % 2**32 - 2**31
