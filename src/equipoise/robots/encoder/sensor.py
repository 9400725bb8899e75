"""Driver of an encoder board that sends E-lines, an `AngleSensor`.

A line that is inconsistent with the one before (`consistency`) is dropped and counted. Several in a
row show that the board has restarted or its counts have jumped: the zero is void, which is a
permanent error. The error of an accepted line is bounded by a possible motion.

Consistent lines never count as a restart, however late they arrive (latency timer of a USB adapter,
stalled host). Lines that arrive much earlier than those before are an error, which names the
lateness of those before.

`samples` never blocks, prints or waits.
"""

from collections.abc import Callable
from math import inf
from typing import Final

from equipoise.errors import LinkError
from equipoise.rig.interfaces import Clock, Sample, Transport
from equipoise.robots.encoder.codec import REQUEST, Banner, Decoder, Flags, Reading
from equipoise.robots.encoder.consistency import (
    MAX_LATENESS,
    MAX_RATE,
    SILENCE,
    HostTime,
    Inconsistency,
    LineOrder,
)

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
        self._failed = "is not connected; connect it first"
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
            self._failed = str(error).removeprefix(f"{self._name} ")
            raise
        self._failed = ""

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
                self._begin(now, order.last)
                return
            clock.wait_until(now + POLL_PERIOD)
        raise LinkError(
            f"{self._name} sends a banner but no steady counts; check its firmware, and that "
            f"the link is fast enough for {banner.rate_hz} lines per second"
        )

    def _begin(self, now: float, last: Reading) -> None:
        # [s]: a banner until then may be a late reply; a later one shows a restart.
        self._banner_until = now + 1.0
        self._block_end, self._block_lateness = now + 1.0, inf
        time = self._time(last.t_us, now)
        self._first = [Sample(time, self._counts, False, bool(last.flags & Flags.ILLEGAL), 0)]

    # Reading.

    def samples(self) -> list[Sample]:
        """Return the samples since the last call, the oldest first.

        Times are on the rig's clock and increase; counts grow with theta.

        Raises:
            LinkError: The link is down or silent, the board restarted, its counts jumped, or its
                lines are late. The zero is void then.
        """
        if self._failed or self._transport is None:
            raise LinkError(f"{self._name} {self._failed}")
        try:
            data = self._transport.read()
        except LinkError as error:
            raise self._fail(f"is gone: {error}") from None
        now = self._clock.now()
        samples, self._first = self._first, []
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
        self._failed = self._failed or "is closed"

    def _take(self, line: Reading, now: float) -> list[Sample]:
        """Return the sample of a line, or no sample for an inconsistent line."""
        ahead = self._time.ahead(line.t_us, now)
        if why := self._order.inconsistency(line, ahead):
            self._drop(line, why)
            return []
        if ahead > MAX_LATENESS:
            raise self._late(ahead)
        missing, step = self._order.accept(line)
        self._received = now
        self._counts += self._sign * step
        down = bool(line.flags & Flags.DOWN)
        pressed = bool(line.flags & Flags.PRESSED) or (down and not self._down)
        self._down = down
        time = self._time(line.t_us, now)
        self._watch_lateness(now)
        return [Sample(time, self._counts, pressed, bool(line.flags & Flags.ILLEGAL), missing)]

    def _drop(self, line: Reading, why: Inconsistency) -> None:
        self._decoder.rejected += 1
        if not self._order.drop():
            return
        if why == "time":
            raise self._fail(f"began anew with line {line.seq}: it restarted, and its zero is void")
        raise self._fail(
            f"jumped to {line.counts} counts, faster than {MAX_RATE:g} rad/s; check the encoder's "
            "coupling, wires and counts per revolution, then connect and reference again"
        )

    def _watch_lateness(self, now: float) -> None:
        self._block_lateness = min(self._block_lateness, self._time.lateness)
        if now < self._block_end:
            return
        if self._block_lateness > MAX_LATENESS:
            raise self._late(self._block_lateness)
        self._block_end, self._block_lateness = now + 1.0, inf

    def _late(self, lateness: float) -> LinkError:
        return self._fail(
            f"delivers its lines {1e3 * lateness:.0f} ms late, expected at most "
            f"{1e3 * MAX_LATENESS:.0f} ms; take load off this computer, set a USB adapter's "
            "latency timer to 1 ms, or use a faster link or a board with a quartz"
        )

    def _fail(self, what: str) -> LinkError:
        self._failed = what
        return LinkError(f"{self._name} {what}")
