"""An encoder behind a board that speaks E-line, as an `AngleSensor`.

The checksum lets one of 256 badly damaged lines through. So a line must also follow from the one
before it: its sequence and its time must agree with the board's rate, and its count with what a
pendulum can do. One that does not follow is dropped and counted; when several in a row do not, it
is the board that has changed (it restarted, or its counts jumped), and the zero is void: that is an
error, which stays. What passes can be wrong by no more than a true motion could be.

Lines that follow are never a restart, however late they arrive (a USB adapter's latency timer, a
host that stands still). Where they arrive earlier than those before, the times given out catch up
at once while nothing depends on them: in the first second, and while the count stands still. At
another time that is an error, which names the lateness.

Nothing in `samples` blocks, prints or waits.
"""

from collections.abc import Callable
from math import ceil, inf, pi
from typing import Final, NamedTuple

from equipoise.devices.encoder.codec import REQUEST, Banner, Decoder, Flags, Reading
from equipoise.devices.encoder.mapping import HURRY, SLEW, WRAP_US, HostTime
from equipoise.devices.interfaces import Clock, Sample, Transport
from equipoise.errors import LinkError

FASTEST: Final = 40.0
"""No pendulum turns faster [rad/s]: a fall from upright reaches 17 rad/s where w2 is 70 1/s^2, and
a hand may add to it."""
SLACK_COUNTS: Final = 2
"""Steps by which two counts may differ beyond their motion: one at each end."""
JITTER: Final = 0.5
"""A line's time may be off its sequence by this share of a period ..."""
DRIFT: Final = 0.01
"""... and by this share of the time since the line before."""
PERSISTENT: Final = 5
"""So many lines in a row that do not follow are no accident: a chance of 256^-5 for noise."""
SILENCE: Final = 0.5
"""Without a line for so long the link is down [s]: a run stops on stale counts long before."""
CONNECT_TIMEOUT: Final = 6.0
"""So long a board may take to say who it is [s]: an Arduino restarts when its port is opened, and
its boot loader waits 2 s."""
ASKING: Final = 0.5
"""So often it is asked until then [s]."""
ANSWERS: Final = 1.0
"""Time after connecting in which a banner may still be an answer, a later one tells of a restart,
and in which nothing depends on the times of samples [s]."""
SETTLING: Final = 0.2
"""Time for which lines are only timed before the first sample is given out [s]; it begins again
where a line arrives earlier than those before by more than `POLL`."""
STILL: Final = 1.0
"""Nothing depends on the times of a count that has stood still for this long [s]."""
LATEST: Final = 0.02
"""Largest accepted lateness of the fastest line of a second, and largest time by which a line may
arrive before the time that is given to it [s]."""
POLL: Final = 0.005
"""Pause between two looks while connecting [s]."""
_COUNT_WRAP: Final = 2**32
_SEQ_WRAP: Final = 2**16


class Tally(NamedTuple):
    """What became of the lines since the connection was made."""

    accepted: int = 0
    """Samples given out."""
    rejected: int = 0
    """Lines that were damaged, by grammar or checksum."""
    gaps: int = 0
    """Places where lines are missing from the sequence, damaged ones included."""
    missing: int = 0
    """Lines that are missing there."""
    untimely: int = 0
    """Lines dropped since sequence and time did not agree, or time went back."""
    jumps: int = 0
    """Lines dropped since the count had moved faster than any pendulum."""
    illegal: int = 0
    """Samples whose board had met an illegal transition."""


class LineEncoder:
    """An encoder whose board sends E-lines: an `AngleSensor`."""

    def __init__(
        self,
        open_transport: Callable[[], Transport],
        clock: Clock,
        *,
        counts_per_rev: int | None = None,
        sign: int = 1,
        fastest: float = FASTEST,
        name: str = "the encoder's board",
    ) -> None:
        """Describe the encoder; nothing is opened yet.

        Args:
            open_transport: Opens the link to the board; raises LinkError where it cannot.
            clock: The rig's clock.
            counts_per_rev: Counts per revolution that the rig expects, after x4; a board that says
                otherwise is refused. None takes the board's word.
            sign: 1 if the board's counts grow with theta, -1 if they fall; samples always grow.
            fastest: No motion is faster [rad/s].
            name: What messages call the board: its address.
        """
        self._open = open_transport
        self._clock = clock
        self._expected = counts_per_rev
        self._sign = sign
        self._fastest = fastest
        self._name = name
        self._transport: Transport | None = None
        self._banner: Banner | None = None
        self._failed = "is not connected; connect it first"
        self._reset()

    def _reset(self) -> None:
        self._decoder = Decoder()
        self._tally = Tally()
        self._answered = 0.0
        self._last: Reading | None = None
        self._counts = 0
        self._down = False
        self._rest_counts, self._moved = 0, self._clock.now()
        self._strangers = 0
        self._stride = 0.0
        self._heard = self._clock.now()
        self._block_end = 0.0
        self._block_lateness = inf
        self._first: list[Sample] = []

    @property
    def counts_per_rev(self) -> int:
        """Counts per revolution, after x4, as the board says.

        Raises:
            LinkError: The board was not asked yet, and the rig does not say.
        """
        if self._banner is None and self._expected is not None:
            return self._expected
        return self.banner.counts_per_rev

    @property
    def banner(self) -> Banner:
        """Who the board says it is.

        Raises:
            LinkError: The board was not asked yet.
        """
        if self._banner is None:
            raise LinkError(f"{self._name} is not connected; connect it first")
        return self._banner

    @property
    def description(self) -> str:
        """Name of the board and its properties, as it says."""
        board = self._banner
        if board is None:
            return self._name
        return (
            f"{board.name} {board.firmware}: {board.counts_per_rev} counts per revolution, "
            f"{board.rate_hz} per second"
        )

    @property
    def rejected(self) -> int:
        """Number of lines that were damaged or did not follow, since connecting."""
        tally = self.tally
        return tally.rejected + tally.untimely + tally.jumps

    @property
    def tally(self) -> Tally:
        """What became of the lines since the connection was made."""
        return self._tally._replace(rejected=self._decoder.rejected)

    # Connecting.

    def connect(self) -> None:
        """Open the link, ask the board who it is, and wait for its first line.

        Raises:
            LinkError: The link cannot be opened, the board says nothing that can be read, or it has
                other counts per revolution than the rig.
        """
        self.close()
        self._reset()
        self._transport = transport = self._open()
        try:
            self._banner = self._ask(transport)
            self._settle(transport)
        except LinkError as error:
            self.close()
            self._failed = str(error).removeprefix(f"{self._name} ")
            raise
        self._failed = ""

    def _ask(self, transport: Transport) -> Banner:
        clock, came = self._clock, False
        asking = began = clock.now()
        while (now := clock.now()) < began + CONNECT_TIMEOUT:
            if now >= asking:
                transport.write(REQUEST)
                asking += ASKING
            data = transport.read()
            came = came or bool(data)
            for line in self._decoder.feed(data):
                if not isinstance(line, Banner):
                    continue
                if self._expected is not None and line.counts_per_rev != self._expected:
                    raise LinkError(
                        f"{self._name} ({line.name}) counts {line.counts_per_rev} per revolution, "
                        f"the rig expects {self._expected} (after x4); correct the rig's "
                        "counts_per_rev or the board's COUNTS_PER_REV"
                    )
                return line
            clock.wait_until(now + POLL)
        if not came:
            raise LinkError(
                f"{self._name} said nothing for {CONNECT_TIMEOUT:g} s; check its power and its "
                "address, and that the firmware is on it (firmware/README.md)"
            )
        raise LinkError(
            f"{self._name} did not say who it is within {CONNECT_TIMEOUT:g} s "
            f"({self._decoder.rejected} lines could not be read); expected E-lines: check the "
            "baud rate, the wires, and that it is the encoder's board"
        )

    def _settle(self, transport: Transport) -> None:
        """Time the lines that come; they agree with each other before any is given out."""
        clock = self._clock
        until, ready = clock.now() + CONNECT_TIMEOUT, 0.0
        while (now := clock.now()) < until:
            for line in self._decoder.feed(transport.read()):
                if isinstance(line, Banner):
                    continue
                if self._last is not None and self._why_not(line, self._last):
                    self._strangers += 1
                    if self._strangers < PERSISTENT:
                        continue
                    # Nothing was given out: a board that restarts meanwhile may.
                    self._last = None
                if self._last is None:
                    self._time, ready = HostTime(line.t_us, now), now + SETTLING
                elif self._time.ahead(line.t_us, now) > POLL:
                    ready = now + SETTLING
                self._strangers = 0
                self._time.settle(line.t_us, now)
                self._heard = now
                self._last, self._counts = line, self._sign * line.counts
                self._down = bool(line.flags & Flags.DOWN)
            if self._last is not None and now == self._heard >= ready:
                self._begin(now, self._last)
                return
            clock.wait_until(now + POLL)
        raise LinkError(
            f"{self._name} says who it is but sends no steady counts; check its firmware, and that "
            f"the link is fast enough for {self.banner.rate_hz} lines per second"
        )

    def _begin(self, now: float, last: Reading) -> None:
        self._answered = now + ANSWERS
        self._block_end, self._block_lateness = now + 1.0, inf
        self._rest_counts, self._moved = self._counts, now
        time = self._time(last.t_us, now)
        self._first = [Sample(time, self._counts, False, bool(last.flags & Flags.ILLEGAL), 0)]
        self._tally = Tally(accepted=1, illegal=int(self._first[0].illegal))

    # Reading.

    def samples(self) -> list[Sample]:
        """Take what came since the last call, the oldest first.

        Times are on the rig's clock and increase; counts grow with theta.

        Raises:
            LinkError: The link is down or silent, or the board is no longer what it was: it
                restarted, its counts jumped, or its lines come ever later. The zero is void then.
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
            if isinstance(line, Banner):
                self._hear_banner(now)
            elif sample := self._take(line, now):
                samples.append(sample)
        if now > self._heard + SILENCE:
            unread = self._decoder.rejected
            raise self._fail(
                f"sent no line that can be used for {SILENCE:g} s ({unread} damaged since the "
                "connection was made); check its power, its cable and the baud rate"
            )
        return samples

    def close(self) -> None:
        """Let go of the link. Never raises, and may be called again."""
        if self._transport is not None:
            self._transport.close()
        self._transport = None
        self._failed = self._failed or "is closed; connect it again"

    def _take(self, line: Reading, now: float) -> Sample | None:
        last = self._last or line
        ahead = self._time.ahead(line.t_us, now)
        why = self._why_not(line, last) or self._leaps(line, last, ahead)
        if why:
            self._drop(line, last, why)
            return None
        slew = SLEW if ahead <= LATEST else self._catch_up(ahead, now)
        self._strangers = 0
        self._heard = now
        missing = (line.seq - last.seq) % _SEQ_WRAP - 1
        self._counts += self._sign * _signed(line.counts - last.counts)
        self._last = line
        down = bool(line.flags & Flags.DOWN)
        pressed = bool(line.flags & Flags.PRESSED) or (down and not self._down)
        self._down = down
        illegal = bool(line.flags & Flags.ILLEGAL)
        tally = self._tally
        self._tally = tally._replace(
            accepted=tally.accepted + 1,
            gaps=tally.gaps + (missing > 0),
            missing=tally.missing + missing,
            illegal=tally.illegal + illegal,
        )
        if abs(self._counts - self._rest_counts) > SLACK_COUNTS:
            self._rest_counts, self._moved = self._counts, now
        time = self._time(line.t_us, now, slew)
        self._watch_lateness(now)
        return Sample(time, self._counts, pressed, illegal, missing)

    def _why_not(self, line: Reading, last: Reading) -> str:
        """Return in which respect a line does not follow from the last one; nothing if it does."""
        steps = (line.seq - last.seq) % _SEQ_WRAP
        passed = 1e-6 * ((line.t_us - last.t_us) % WRAP_US)
        period = 1.0 / self.banner.rate_hz
        if steps == 0 or abs(passed - steps * period) > JITTER * period + DRIFT * passed:
            return "time"
        # After a jump the reach does not grow with the lines dropped: it would soon allow the jump.
        self._stride = min(self._stride, passed) if self._strangers else passed
        per_radian = self.banner.counts_per_rev / (2.0 * pi)
        most = ceil(self._fastest * per_radian * self._stride) + SLACK_COUNTS
        return "count" if abs(_signed(line.counts - last.counts)) > most else ""

    def _leaps(self, line: Reading, last: Reading, ahead: float) -> str:
        """Return "time" for a line that is ahead of its arrival only because lines are missing.

        A forged line is so alone. Several in a row show that the lines before came late, but for
        those that are ahead by more than `SILENCE`: no line comes that late.
        """
        passed = 1e-6 * ((line.t_us - last.t_us) % WRAP_US)
        alone = self._strangers + 1 < PERSISTENT
        leaps = min(ahead, passed) > LATEST and (alone or ahead > SILENCE)
        return "time" if leaps else ""

    def _catch_up(self, ahead: float, now: float) -> float:
        """Return how fast the times may catch up with lines that do not come late any more.

        Raises:
            LinkError: Something depends on the times that were given out.
        """
        if now <= self._answered or now > self._moved + STILL:
            return HURRY
        raise self._fail(
            f"delivered its lines {1e3 * ahead:.0f} ms late until now, expected at most "
            f"{1e3 * LATEST:.0f} ms: the times of its samples were wrong by that while the count "
            "moved; set the USB adapter's latency timer to 1 ms or take load off the host, then "
            "connect again"
        )

    def _drop(self, line: Reading, last: Reading, why: str) -> None:
        tally = self._tally
        if why == "time":
            self._tally = tally._replace(untimely=tally.untimely + 1)
        else:
            self._tally = tally._replace(jumps=tally.jumps + 1)
        self._strangers += 1
        if self._strangers < PERSISTENT:
            return
        if why == "time":
            raise self._fail(
                f"began anew (line {line.seq} at {1e-6 * line.t_us:.3f} s after line {last.seq} at "
                f"{1e-6 * last.t_us:.3f} s): it restarted, and its zero is void; check its power, "
                "then connect and reference again"
            )
        raise self._fail(
            f"jumped from {last.counts} to {line.counts} counts, faster than {self._fastest:g} "
            "rad/s; check the encoder's coupling, wires and counts per revolution, then "
            "connect and reference again"
        )

    def _hear_banner(self, now: float) -> None:
        if now > self._answered:
            raise self._fail(
                "introduced itself unasked: it restarted, and its zero is void; check its power, "
                "then connect and reference again"
            )

    def _watch_lateness(self, now: float) -> None:
        self._block_lateness = min(self._block_lateness, self._time.lateness)
        if now < self._block_end:
            return
        if self._block_lateness > LATEST:
            raise self._fail(
                f"delivers its lines late, even the fastest of a second by "
                f"{1e3 * self._block_lateness:.0f} ms, expected at most {1e3 * LATEST:.0f} ms: the "
                "host or a USB adapter holds them back, the link is too slow for its rate, or its "
                "clock is slow by more than 0.1 %; take load off the host, set the adapter's "
                "latency timer to 1 ms, use a faster link or lower rate, or a board with a quartz"
            )
        self._block_end, self._block_lateness = now + 1.0, inf

    def _fail(self, what: str) -> LinkError:
        self._failed = what
        return LinkError(f"{self._name} {what}")


def _signed(difference: int) -> int:
    """Return a difference of 32-bit counts that may have wrapped."""
    return (difference + _COUNT_WRAP // 2) % _COUNT_WRAP - _COUNT_WRAP // 2
