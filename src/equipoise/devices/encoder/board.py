"""An emulated encoder board: the same bytes as the firmware's, from any angle, without a wire.

It counts what an angle does, on a clock of its own, and can be given the faults of real boards.
Bytes and times go in, bytes come out: the same board runs in virtual time behind a memory pipe and
in real time on a pseudo-terminal (`terminal.py`).

Not modelled: single edges of the two lines (a fault on them is set by hand), the bounce of the
button, the time that a line takes on its wire, and a buffer that runs full.
"""

from collections.abc import Callable
from math import floor
from typing import Final

import numpy as np

from equipoise.devices.encoder.codec import Banner, Flags, Reading, Requests, encode
from equipoise.model.encoder import counts_from_theta

RATE: Final = 1000
"""Lines per second that the firmware sends [Hz]."""
BOOT: Final = 0.3
"""From a restart to the banner [s]."""
NAME: Final = "emulated"
FIRMWARE: Final = "1.0"


class Board:
    """An emulated board, with its faults as attributes that may be set at any time."""

    def __init__(
        self,
        angle: Callable[[], float],
        *,
        counts_per_rev: int = 8192,
        sign: int = 1,
        rate_hz: int = RATE,
        offset_us: int = 0,
        drift: float = 0.0,
        start: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Switch a board on; its first line comes a period later, after its banner.

        Args:
            angle: Tells theta now, from anywhere [rad]: the spindle's angle relative to its mount.
            counts_per_rev: Counts per revolution, after x4.
            sign: 1 if counts grow with theta, -1 if they fall.
            rate_hz: Lines per second [Hz].
            offset_us: What its clock shows at `start` [us].
            drift: Share by which its clock is fast.
            start: When it is switched on [s].
            seed: Seed of what its malformed lines look like.
        """
        self._angle = angle
        self._rng = np.random.default_rng(seed)
        self._requests = Requests()
        self._drift = drift
        self._now = start
        self.counts_per_rev = counts_per_rev
        """Counts per revolution that it tells."""
        self.rate_hz = rate_hz
        """Lines per second [Hz]."""
        self.sign = sign
        """A wrong sign is a fault."""
        self.factor = 1.0
        """Its counts are too many by this: a fault where it is not 1."""
        self.loss = 0.0
        """Share of the upward counts that it misses: a slow fault."""
        self.frozen = False
        """The count stands still: a fault."""
        self.silent = False
        """No line comes: a fault."""
        self.malformed = 0.0
        """Share of its lines that are damaged: a fault."""
        self._boot(start, start, offset_us)

    def _boot(self, now: float, first: float, t_us: int = 0) -> None:
        self._started, self._start_us = now, t_us
        self._next = first
        self._greets = True
        self._line = 0
        self._theta = self._angle()
        self._at = now
        self._raw = self._counted(self._theta)
        self._count = 0
        self._lost = 0.0
        self._shift = 0
        self._down = self._latched = False
        self._illegal = False
        self._skip = 0
        self._asked = 0

    # What happens to it.

    def feed(self, data: bytes) -> None:
        """Take what the host sent."""
        self._asked += self._requests.feed(data)

    def press(self) -> None:
        """Push the button down."""
        self._down = self._latched = True

    def let_go(self) -> None:
        """Let the button up."""
        self._down = False

    def jump(self, counts: int) -> None:
        """Let the count jump: a slipping coupling, a burst of noise."""
        self._shift += counts

    def zero(self) -> None:
        """Set the count to zero, which no firmware of ours does."""
        self._shift -= self._count + self._shift

    def skip(self, lines: int) -> None:
        """Let the next lines get lost."""
        self._skip += lines

    def meet_illegal(self) -> None:
        """Let both lines of the encoder change at once."""
        self._illegal = True

    def reboot(self) -> None:
        """Restart: the count, the sequence and the clock begin anew, after `BOOT`."""
        self._boot(self._now + BOOT, self._now + BOOT)

    # What it says.

    def advance(self, now: float) -> bytes:
        """Let time pass, and return what it sends meanwhile.

        Between two calls the angle is taken to move evenly: call it about once per period.

        Args:
            now: The time [s], not before that of the last call.
        """
        theta, before, since = self._angle(), self._theta, self._at
        said = bytearray()
        if now >= self._started and self._greets:
            self._greets = False
            said += self._banner()
        if self._asked and now >= self._started:
            said += self._banner() * self._asked
            self._asked = 0
        period = 1.0 / (self.rate_hz * (1.0 + self._drift))
        while self._next + period <= now + 1e-9:
            self._next += period
            share = (self._next - since) / (now - since) if now > since else 1.0
            self._move(before + min(max(share, 0.0), 1.0) * (theta - before))
            said += self._say()
        self._theta, self._at, self._now = theta, max(now, since), now
        return bytes(said)

    def _banner(self) -> bytes:
        return encode(Banner(NAME, FIRMWARE, self.counts_per_rev, self.rate_hz))

    def _counted(self, theta: float) -> int:
        return int(counts_from_theta(self.factor * theta, self.counts_per_rev, self.sign))

    def _move(self, theta: float) -> None:
        raw = self._counted(theta)
        step, self._raw = raw - self._raw, raw
        if self.frozen:
            return
        self._lost += self.loss * max(step, 0)
        missed = floor(self._lost)
        self._lost -= missed
        self._count += step - missed

    def _say(self) -> bytes:
        flags = Flags.DOWN * self._down | Flags.PRESSED * self._latched
        flags |= Flags.ILLEGAL * self._illegal
        clock = (self._next - self._started) * (1.0 + self._drift)
        t_us = (self._start_us + round(1e6 * clock)) % 2**32
        count = (self._count + self._shift + 2**31) % 2**32 - 2**31
        line = encode(Reading(self._line, t_us, count, int(flags)))
        self._line = (self._line + 1) % 2**16
        if self._skip or self.silent:
            self._skip = max(self._skip - 1, 0)
            return b""
        self._latched = self._illegal = False
        if self.malformed > 0.0 and self._rng.random() < self.malformed:
            return self._damaged(line)
        return line

    def _damaged(self, line: bytes) -> bytes:
        """Return a line as a bad wire leaves it: bytes changed, lost, doubled, or noise."""
        rng = self._rng
        kind, place = int(rng.integers(4)), int(rng.integers(len(line)))
        if kind == 0:
            end = min(place + 1 + int(rng.integers(4)), len(line))
            return line[:place] + rng.bytes(end - place) + line[end:]
        if kind == 1:
            return line[:place] + line[place + 1 + int(rng.integers(8)) :]
        if kind == 2:
            return line[:place] + line[max(place - 3, 0) :]
        return rng.bytes(len(line))
