"""Driver of an encoder board that sends E-lines, an `AngleSensor`.

**Order.** The checksum accepts one of 256 badly damaged lines. Each line must therefore also fit
the one before: sequence and time the board's rate, the count the fastest motion of a pendulum. A
line that does not is dropped and counted. Several in a row show that the board has restarted or its
counts have jumped: the zero is void, which is a permanent error. The error of an accepted line is
bounded by a possible motion.

**Times** on the clock of the host. A line always arrives after its count was taken. The smallest
difference between arrival and time stamp is therefore the best estimate of the zero of the board's
clock. The estimate follows a smaller difference, and otherwise rises by `MAX_CLOCK_ERROR`, so that
it also follows a slow clock. Converted times always increase, and are free of the jitter of
arrival. A line that arrives before its converted time proves that all earlier lines were late. The
estimate then falls by `SLEW`, which keeps rates of the angle correct within a tenth.

Consistent lines never count as a restart, however late they arrive (latency timer of a USB adapter,
stalled host). Lines that arrive much earlier than those before are an error, which names the
lateness of those before.

`samples` never blocks, prints or waits.
"""

from collections.abc import Callable
from math import ceil, inf, pi
from typing import Final, Literal

from equipoise.errors import LinkError
from equipoise.rig.interfaces import Clock, Sample, Transport
from equipoise.robots.encoder.codec import REQUEST, Banner, Decoder, Flags, Reading

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
"""Maximum fraction by which a board's clock is slow [-]: twenty times the error of a quartz. An
Uno's ceramic resonator can be off by 5e-3, which is not accepted."""
SLEW: Final = 0.1
"""Maximum fall of the estimate per elapsed time [-]; below 1, so that converted times increase."""


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

    def inconsistency(self, line: Reading, ahead: float = 0.0) -> Literal["", "time", "count"]:
        """Return which part of a line is inconsistent with the last one; empty for none.

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


CONNECT_TIMEOUT: Final = 6.0
"""Timeout of the banner [s]. An Arduino restarts when its port is opened, and its boot loader waits
2 s."""
SETTLING: Final = 0.2
"""Duration of the timing of lines before the first sample [s]; restarts when a line
arrives earlier than those before by more than `POLL_PERIOD`."""
POLL_PERIOD: Final = 0.005
"""Time between two reads while connecting [s]."""


class LineEncoder:
    """Encoder board that sends E-lines, as an `AngleSensor`."""

    def __init__(
        self,
        open_transport: Callable[[], Transport],
        clock: Clock,
        *,
        counts_per_rev: int | None = None,
        sign: int = 1,
        name: str = "the encoder's board",
    ) -> None:
        """Create the driver; nothing is opened yet.

        Args:
            open_transport: Opens the link to the board, or raises `LinkError`.
            clock: Clock of the rig.
            counts_per_rev: Expected counts per revolution, after x4; a board with another number is
                refused; by default any number is accepted.
            sign: 1 if the board's counts grow with theta, -1 if they fall; samples always grow.
            name: Name of the board in messages: its address.
        """
        self._open, self._clock, self._name = open_transport, clock, name
        self._expected, self._sign = counts_per_rev, sign
        self._transport: Transport | None = None
        self._banner: Banner | None = None
        self._failure = f"{name} is not connected; connect it first"
        self._decoder = Decoder()
        self._down, self._counts = False, 0
        self._received = clock.now()

    @property
    def counts_per_rev(self) -> int:
        """Counts per revolution, after x4, from the board; before connecting the expected number.

        Raises:
            LinkError: The sensor is not connected, and no number is expected.
        """
        counts = self._expected if self._banner is None else self._banner.counts_per_rev
        if counts is None:
            raise LinkError(f"{self._name} is not connected; connect it first")
        return counts

    @property
    def rejected(self) -> int:
        """Number of damaged and inconsistent lines since connecting."""
        return self._decoder.rejected

    # Connecting.

    def connect(self) -> None:
        """Open the link, request the board's banner, and wait for its first line; once only.

        Raises:
            LinkError: The link cannot be opened, the board sends no valid banner or lines, or its
                counts per revolution differ from the rig's.
        """
        self._transport = transport = self._open()
        try:
            self._banner = self._request_banner(transport)
            self._settle(transport, self._banner)
        except LinkError as error:
            self.close()
            self._failure = str(error)
            raise
        self._failure = ""

    def _request_banner(self, transport: Transport) -> Banner:
        clock = self._clock
        due = began = clock.now()
        while (now := clock.now()) < began + CONNECT_TIMEOUT:
            if now >= due:
                transport.write(REQUEST)
                due += 0.5  # the time between two requests
            for line in self._decoder.feed(transport.read()):
                if isinstance(line, Banner):
                    if self._expected not in (None, line.counts_per_rev):
                        raise LinkError(
                            f"{self._name} ({line.name}) counts {line.counts_per_rev} per "
                            f"revolution, the rig expects {self._expected} (after x4); correct "
                            "the rig's counts_per_rev or the board's COUNTS_PER_REV"
                        )
                    return line
            clock.wait_until(now + POLL_PERIOD)
        raise LinkError(
            f"{self._name} sent no banner within {CONNECT_TIMEOUT:g} s and {self.rejected} damaged "
            "lines; check its power, its cable and its address, and that the firmware is on it "
            "(firmware/README.md)"
        )

    def _settle(self, transport: Transport, banner: Banner) -> None:
        """Time the received lines until they are consistent, without returning samples."""
        clock = self._clock
        until, ready = clock.now() + CONNECT_TIMEOUT, 0.0
        self._order = order = LineOrder(banner)
        while (now := clock.now()) < until:
            for line in self._decoder.feed(transport.read()):
                if isinstance(line, Banner):
                    continue
                if order.last is not None and order.inconsistency(line):
                    if not order.drop():
                        continue
                    # No sample was returned yet, so that the board may restart.
                    order.last = None
                if order.last is None:
                    self._time, ready = HostTime(line.t_us, now), now + SETTLING
                elif self._time.ahead(line.t_us, now) > POLL_PERIOD:
                    ready = now + SETTLING
                self._time.settle(line.t_us, now)
                order.accept(line)
                self._received, self._counts = now, self._sign * line.counts
                self._down = bool(line.flags & Flags.DOWN)
            if order.last is not None and now == self._received >= ready:
                self._banner_until = now + 1.0  # [s]: a later banner shows a restart
                self._block_end, self._block_lateness = now + 1.0, inf
                return
            clock.wait_until(now + POLL_PERIOD)
        raise LinkError(
            f"{self._name} sends a banner but no steady counts; check its firmware, and that "
            f"the link is fast enough for {banner.rate_hz} lines per second"
        )

    # Reading.

    def samples(self) -> list[Sample]:
        """Return the samples since the last call, the oldest first.

        Times are on the rig's clock and increase; counts grow with theta.

        Raises:
            LinkError: The link is down or silent, the board restarted, its counts jumped, or its
                lines are late. The zero is void then.
        """
        if self._failure or self._transport is None:
            raise LinkError(self._failure)
        try:
            data = self._transport.read()
        except LinkError as error:
            raise self._fail(f"is gone: {error}") from None
        now = self._clock.now()
        samples: list[Sample] = []
        for line in self._decoder.feed(data):
            if not isinstance(line, Banner):
                samples += self._take(line, now)
            elif now > self._banner_until:
                raise self._fail(
                    "sent a banner: it restarted, and its zero is void; check its power"
                )
        if now > self._received + SILENCE:
            raise self._fail(
                f"sent no valid line for {SILENCE:g} s ({self.rejected} rejected since "
                "connecting); check its power, its cable and the baud rate"
            )
        return samples

    def close(self) -> None:
        """Close the link for good. Never raises, and may be called again."""
        if self._transport is not None:
            self._transport.close()
        self._transport = None
        self._failure = self._failure or f"{self._name} is closed"

    def _take(self, line: Reading, now: float) -> list[Sample]:
        """Return the sample of a line, or no sample for an inconsistent line."""
        ahead = self._time.ahead(line.t_us, now)
        if why := self._order.inconsistency(line, ahead):
            self._decoder.rejected += 1
            if not self._order.drop():
                return []
            if why == "time":
                raise self._fail(
                    f"began anew with line {line.seq}: it restarted, and its zero is void"
                )
            raise self._fail(
                f"jumped to {line.counts} counts, faster than {MAX_RATE:g} rad/s; check the "
                "encoder's coupling, wires and counts per revolution, then connect and reference "
                "again"
            )
        if ahead > MAX_LATENESS:
            raise self._late(ahead)
        missing, step = self._order.accept(line)
        self._received = now
        self._counts += self._sign * step
        down = bool(line.flags & Flags.DOWN)
        pressed = bool(line.flags & Flags.PRESSED) or (down and not self._down)
        self._down = down
        time = self._time(line.t_us, now)
        self._block_lateness = min(self._block_lateness, self._time.lateness)
        if now >= self._block_end:
            if self._block_lateness > MAX_LATENESS:
                raise self._late(self._block_lateness)
            self._block_end, self._block_lateness = now + 1.0, inf
        return [Sample(time, self._counts, pressed, bool(line.flags & Flags.ILLEGAL), missing)]

    def _late(self, lateness: float) -> LinkError:
        return self._fail(
            f"delivers its lines {1e3 * lateness:.0f} ms late, expected at most "
            f"{1e3 * MAX_LATENESS:.0f} ms; take load off this computer, set a USB adapter's "
            "latency timer to 1 ms, or use a faster link or a board with a quartz"
        )

    def _fail(self, problem: str) -> LinkError:
        """Return the permanent error of a problem, the rest of a sentence about the board."""
        self._failure = f"{self._name} {problem}"
        return LinkError(self._failure)
