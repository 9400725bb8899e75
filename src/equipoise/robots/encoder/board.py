"""Emulator of an encoder board, which sends the same bytes as the firmware for any angle.

The board counts an angle on its own clock. Its inputs are bytes and times, its outputs bytes: it
runs in virtual time behind a memory pipe and in real time on a pseudo-terminal (`Terminal`).

Not modelled: single edges of the two lines (`illegal` sets their fault), the bounce of the
button, the transmission time of a line, and a full buffer.
"""

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from equipoise.errors import InputError, OutsideError
from equipoise.model.encoder import counts_from_theta
from equipoise.rig.transports import CHUNK
from equipoise.robots.encoder.codec import Banner, Flags, Reading, count_requests, encode

BOOT: Final = 0.3
"""Time from a restart to the banner [s]."""


@dataclass(eq=False)
class Board:
    """Emulated board; its attributes may be changed at any time.

    At its start it sends its banner, and its first line a period later.
    """

    angle: Callable[[], float]
    """Returns theta, the spindle's angle relative to its mount, from any zero [rad]."""
    counts_per_rev: int = 8192
    """Counts per revolution in the banner, after x4."""
    sign: int = 1
    """1 if counts grow with theta, -1 if they fall; the wrong sign is a fault."""
    rate_hz: int = 1000
    """Line rate [Hz]."""
    offset_us: int = 0
    """Time of the board's clock at `start` [us]."""
    drift: float = 0.0
    """Relative error of the board's clock, positive if fast [-]."""
    start: float = 0.0
    """Time at which the board is switched on [s]."""
    illegal: bool = field(default=False, init=False)
    """Whether both lines of the encoder have changed at once since the last line: a fault."""

    def __post_init__(self) -> None:
        """Switch the board on."""
        self._received = b""
        self._now = self.start
        self._boot(self.start, self.offset_us)

    def _boot(self, now: float, t_us: int = 0) -> None:
        self._started = self._next = self._at = now
        self._start_us = t_us
        self._theta = self.angle()
        self._zero = self._counted(self._theta)
        self._line, self._requested = 0, 1  # lines sent; banners to send, the first unasked
        self._down = self._latched = self.illegal = False

    # Inputs.

    def feed(self, data: bytes) -> None:
        """Receive bytes from the host."""
        requests, self._received = count_requests(self._received + data)
        self._requested += requests

    def press(self, down: bool = True) -> None:
        """Press the button, or release it; a press is latched until the next line."""
        self._latched |= down and not self._down
        self._down = down

    def reboot(self) -> None:
        """Restart count, sequence and clock, after `BOOT`."""
        self._boot(self._now + BOOT)

    # Outputs.

    def advance(self, now: float) -> bytes:
        """Advance to a time, and return the bytes sent meanwhile.

        The angle is interpolated linearly between two calls: call it about once per period.

        Args:
            now: The time [s], not before that of the last call.
        """
        theta, before, since = self.angle(), self._theta, self._at
        sent = bytearray()
        if now >= self._started:
            banner = encode(Banner("emulated", "1.0", self.counts_per_rev, self.rate_hz))
            sent += banner * self._requested
            self._requested = 0
        period = 1.0 / (self.rate_hz * (1.0 + self.drift))
        while self._next + period <= now + 1e-9:
            self._next += period
            fraction = (self._next - since) / (now - since) if now > since else 1.0
            sent += self._line_at(before + min(max(fraction, 0.0), 1.0) * (theta - before))
        self._theta, self._at, self._now = theta, max(now, since), now
        return bytes(sent)

    def _counted(self, theta: float) -> int:
        return int(counts_from_theta(theta, self.counts_per_rev, self.sign))

    def _line_at(self, theta: float) -> bytes:
        flags = Flags.DOWN * self._down | Flags.PRESSED * self._latched
        flags |= Flags.ILLEGAL * self.illegal
        clock = (self._next - self._started) * (1.0 + self.drift)
        t_us = (self._start_us + round(1e6 * clock)) % 2**32
        count = (self._counted(theta) - self._zero + 2**31) % 2**32 - 2**31
        line = encode(Reading(self._line, t_us, count, int(flags)))
        self._line = (self._line + 1) % 2**16
        self._latched = self.illegal = False
        return line


class Terminal:
    """Pseudo-terminal with an emulated board behind it; to a client a board on USB."""

    def __init__(self, board: Board, link: Path | None = None) -> None:
        """Open the terminal.

        Args:
            board: The board; its lines are dropped while no client reads, as those of a real board.
            link: Second name of the terminal, a symbolic link; replaces another symbolic link.

        Raises:
            InputError: A file has that name.
            OutsideError: There are no pseudo-terminals here.
        """
        if link is not None and link.exists() and not link.is_symlink():
            raise InputError(f"{link} is a file; give another name for the terminal")
        try:
            import pty
            import tty

            self._ours, self._theirs = pty.openpty()
        except (ImportError, OSError) as error:
            raise OutsideError(
                f"{sys.platform} has no pseudo-terminal for the board ({error}); use Linux or macOS"
            ) from None
        # The client's side stays open here: without a client, reads on our side would fail.
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._board, self._link = board, link
        self.path = Path(os.ttyname(self._theirs))
        """Name of the terminal; its address is `serial://` with this name."""
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self.path)

    def advance(self, now: float) -> None:
        """Transfer bytes both ways; call it about once per period of the board.

        Args:
            now: The time [s].
        """
        with suppress(BlockingIOError):
            self._board.feed(os.read(self._ours, CHUNK))
        sent = self._board.advance(now)
        with suppress(BlockingIOError):  # a full buffer loses lines, and cuts one
            os.write(self._ours, sent)

    def close(self) -> None:
        """Close the terminal, and remove its second name."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._ours)
        os.close(self._theirs)
