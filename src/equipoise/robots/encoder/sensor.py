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

from collections.abc import Callable, Iterator
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


class LineStream:
    """Lines of a board in order: their counts, and their times on the host's clock."""

    def __init__(self, banner: Banner, first: Reading, arrival: float) -> None:
        """Start at a first line, at its time of arrival on the host's clock [s]."""
        self._period = 1.0 / banner.rate_hz
        self._counts_per_radian = banner.counts_per_rev / (2.0 * pi)
        self._last, self._stride, self._inconsistent = first, 0.0, 0
        self._elapsed_us, self._zero = 0, arrival
        self._counts = first.counts  # they do not wrap
        self.settles = True
        """Whether samples are not used yet, so that their times may decrease."""
        self.received = arrival
        """Time of its arrival [s]."""
        self.lateness = 0.0
        """Delay of the newest sample beyond the delay of the fastest lines [s]."""

    def inconsistency(self, line: Reading, ahead: float = 0.0) -> Literal["", "time", "count"]:
        """Return which part of a line is inconsistent with the last one; empty for none.

        A line that is ahead of its arrival only because lines are missing is forged if it comes
        alone. Several in a row show that earlier lines were late, unless they are ahead by more
        than `SILENCE`: no line is that late.

        Args:
            line: The line.
            ahead: Time by which its converted time exceeds its arrival [s].
        """
        steps, passed = self._steps(line), 1e-6 * self._passed_us(line)
        # Half a period of jitter, and one percent of drift.
        tolerance = 0.5 * self._period + 0.01 * passed
        if steps == 0 or abs(passed - steps * self._period) > tolerance:
            return "time"
        # After a jump the bound does not grow with dropped lines: it would soon allow the jump.
        self._stride = min(self._stride, passed) if self._inconsistent else passed
        # Each end of the motion may be one step off.
        most = ceil(MAX_RATE * self._counts_per_radian * self._stride) + 2
        if abs(signed(line.counts - self._last.counts)) > most:
            return "count"
        alone = self._inconsistent + 1 < MAX_INCONSISTENT
        leaps = min(ahead, passed) > MAX_LATENESS and (alone or ahead > SILENCE)
        return "time" if leaps else ""

    def drop(self) -> bool:
        """Count an inconsistent line; return whether it is one of too many."""
        self._inconsistent += 1
        return self._inconsistent >= MAX_INCONSISTENT

    def ahead(self, line: Reading, arrival: float) -> float:
        """Return by how much a line's converted time exceeds its arrival [s]; normally negative."""
        return self._zero + 1e-6 * (self._elapsed_us + self._passed_us(line)) - arrival

    def accept(self, line: Reading, arrival: float, sign: int) -> Sample:
        """Accept a line, and return its sample, whose counts have a sign.

        While it settles, the estimate of the clock falls at once.
        """
        last, missing, passed_us = self._last, self._steps(line) - 1, self._passed_us(line)
        self._last, self._inconsistent, self.received = line, 0, arrival
        self._elapsed_us += passed_us
        self._counts += signed(line.counts - last.counts)
        passed, difference = 1e-6 * passed_us, arrival - 1e-6 * self._elapsed_us
        rise, fall = (0.0, inf) if self.settles else (MAX_CLOCK_ERROR * passed, SLEW * passed)
        self._zero = max(min(difference, self._zero + rise), self._zero - fall)
        self.lateness = max(difference - self._zero, 0.0)
        time = self._zero + 1e-6 * self._elapsed_us
        began = line.flags & ~last.flags & Flags.DOWN
        pressed, illegal = bool(line.flags & Flags.PRESSED or began), line.flags & Flags.ILLEGAL
        return Sample(time, sign * self._counts, pressed, bool(illegal), missing)

    def _steps(self, line: Reading) -> int:
        return (line.seq - self._last.seq) % 2**16

    def _passed_us(self, line: Reading) -> int:
        return (line.t_us - self._last.t_us) % WRAP_US


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
        self._sign = sign
        self.counts_per_rev = counts_per_rev or 0
        """Counts per revolution, after x4, from the board; before connecting the expected number, 0
        without one."""
        self._transport: Transport | None = None
        self._failure = f"{name} is not connected; connect it first"
        self._decoder = Decoder()

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
            banner = self._request_banner(transport)
            self.counts_per_rev = banner.counts_per_rev
            self._stream = self._settled(transport, banner)
        except LinkError as error:
            self.close()
            self._failure = str(error)
            raise
        # A later banner shows a restart [s].
        self._banner_until = self._block_end = self._stream.received + 1.0
        self._block_lateness, self._failure = inf, ""

    def _arriving(self, transport: Transport) -> Iterator[tuple[float, list[Reading | Banner]]]:
        """Yield the lines that have come, with the time [s], until the time to connect is over."""
        until = self._clock.now() + CONNECT_TIMEOUT
        while (now := self._clock.now()) < until:
            yield now, self._decoder.feed(transport.read())
            self._clock.wait_until(now + POLL_PERIOD)

    def _request_banner(self, transport: Transport) -> Banner:
        due = -inf
        for now, lines in self._arriving(transport):
            for line in lines:
                if isinstance(line, Banner):
                    if self.counts_per_rev not in (0, line.counts_per_rev):
                        raise LinkError(
                            f"{self._name} ({line.name}) counts {line.counts_per_rev} per "
                            f"revolution, the rig expects {self.counts_per_rev} (after x4); "
                            "correct the rig's counts_per_rev or the board's COUNTS_PER_REV"
                        )
                    return line
            if now >= due:
                transport.write(REQUEST)
                due = now + 0.5  # the time between two requests
        raise LinkError(
            f"{self._name} sent no banner within {CONNECT_TIMEOUT:g} s and {self.rejected} damaged "
            "lines; check its power, its cable and its address, and that the firmware is on it "
            "(firmware/README.md)"
        )

    def _settled(self, transport: Transport, banner: Banner) -> LineStream:
        """Return the stream of lines once they are consistent and timed, without samples."""
        stream, ready = None, 0.0
        for now, lines in self._arriving(transport):
            for line in lines:
                if isinstance(line, Banner):
                    continue
                if stream is not None and stream.inconsistency(line):
                    if not stream.drop():
                        continue
                    # No sample was returned yet, so that the board may restart.
                    stream = None
                if stream is None:
                    stream, ready = LineStream(banner, line, now), now + SETTLING
                    continue
                if stream.ahead(line, now) > POLL_PERIOD:
                    ready = now + SETTLING
                stream.accept(line, now, self._sign)
            if stream is not None and now == stream.received >= ready:
                stream.settles = False
                return stream
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
        if now > self._stream.received + SILENCE:
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
        stream = self._stream
        ahead = stream.ahead(line, now)
        if why := stream.inconsistency(line, ahead):
            self._decoder.rejected += 1
            if not stream.drop():
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
        sample = stream.accept(line, now, self._sign)
        self._block_lateness = min(self._block_lateness, stream.lateness)
        if now >= self._block_end:
            if self._block_lateness > MAX_LATENESS:
                raise self._late(self._block_lateness)
            self._block_end, self._block_lateness = now + 1.0, inf
        return [sample]

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
