r"""The E-line protocol between an encoder board and the host, both ways, as bytes.

The board sends a line for each period of its rate, and a banner when it starts or is asked::

    E,<seq>,<t_us>,<counts>,<flags>*<crc>\n        E,1023,123456789,-4096,1*1D\n
    I,<name>,<firmware>,<counts per rev>,<rate in Hz>*<crc>\n

The host asks with `?\n`. The checksum is CRC-8/MAXIM over all before the star. The grammar is
strict: there is one spelling of each number (no plus, no leading zero, no blank, no -0), the
checksum is in capitals, a line ends with one line feed. So every change of a line within eight
neighbouring bits is noticed: in what the checksum covers by its polynomial, elsewhere (star,
checksum, line feed) because only one spelling is right. `docs/reference/e-line.md` says more.
"""

import re
from enum import IntFlag
from typing import Final, NamedTuple

from equipoise.errors import InputError

REQUEST: Final = b"?\n"
"""What asks a board for its banner."""
LONGEST: Final = 96
"""Bytes of the longest line without its end: more than any banner has."""

_READING: Final = re.compile(
    rb"E,(0|[1-9][0-9]{0,4}),(0|[1-9][0-9]{0,9}),(0|-?[1-9][0-9]{0,9}),([0-9A-F])\*([0-9A-F]{2})"
)
_BANNER: Final = re.compile(
    rb"I,([A-Za-z][A-Za-z0-9_-]{0,31}),([A-Za-z0-9][A-Za-z0-9._-]{0,15}),"
    rb"([1-9][0-9]{0,8}),([1-9][0-9]{0,5})\*([0-9A-F]{2})"
)


class Flags(IntFlag):
    """What a line says beside the count."""

    DOWN = 1
    """The button is down."""
    PRESSED = 2
    """It was pressed since the line before, even if it is up again."""
    INDEX = 4
    """The index of the encoder was seen since the line before."""
    ILLEGAL = 8
    """Both lines of the encoder changed at once since the line before: a count was lost."""


class Reading(NamedTuple):
    """A line of the encoder, in the units of the wire."""

    seq: int
    """Number of the period since the board started, modulo 2^16."""
    t_us: int
    """The board's clock when it took the count, modulo 2^32 [us]."""
    counts: int
    """Counts after x4 since the board started, from -2^31 to 2^31 - 1."""
    flags: int
    """See `Flags`, 0 to 15."""


class Banner(NamedTuple):
    """Who a board says it is."""

    name: str
    """A letter, then up to 31 letters, digits, _ or -."""
    firmware: str
    """Version of its program: up to 16 letters, digits, dots, _ or -."""
    counts_per_rev: int
    """Counts per revolution, after x4."""
    rate_hz: int
    """Lines per second [Hz]."""


def _table() -> bytes:
    rows = bytearray()
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8C if crc & 1 else 0)
        rows.append(crc)
    return bytes(rows)


_CRC: Final = _table()


def crc8(data: bytes) -> int:
    """Return the CRC-8/MAXIM of bytes: polynomial 0x31, least bit first, from zero.

    Example:
        >>> hex(crc8(b"123456789"))
        '0xa1'
    """
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def encode(line: Reading | Banner) -> bytes:
    r"""Return a line as it is sent, its end included.

    Raises:
        InputError: A value does not fit its field.

    Example:
        >>> encode(Reading(1023, 123456789, -4096, 1))
        b'E,1023,123456789,-4096,1*1D\n'
    """
    if isinstance(line, Reading):
        seq, t_us, counts, flags = line
        body = b"E,%d,%d,%d,%X" % (seq, t_us, counts, flags)
    else:
        name, firmware, counts_per_rev, rate_hz = line
        text = f"I,{name},{firmware},{counts_per_rev},{rate_hz}"
        body = text.encode("ascii", errors="replace")
    whole = b"%s*%02X" % (body, crc8(body))
    if decode(whole) != line:
        raise InputError(f"{line} does not fit the E-line protocol; see its fields' ranges")
    return whole + b"\n"


def decode(line: bytes) -> Reading | Banner | None:
    """Return what a line without its end says; nothing where it is none of the protocol's."""
    if found := _READING.fullmatch(line):
        if crc8(line[:-3]) != int(found[5], 16):
            return None
        reading = Reading(int(found[1]), int(found[2]), int(found[3]), int(found[4], 16))
        fits = reading.seq < 2**16 and reading.t_us < 2**32 and -(2**31) <= reading.counts < 2**31
        return reading if fits else None
    if found := _BANNER.fullmatch(line):
        if crc8(line[:-3]) != int(found[5], 16):
            return None
        return Banner(found[1].decode(), found[2].decode(), int(found[3]), int(found[4]))
    return None


class ELineSplitter:
    """Cuts a stream of bytes into lines.

    What comes before the first end of a line is dropped: one seldom begins to listen between two
    lines. Lines longer than `LONGEST` are dropped, so that memory is bounded.
    """

    def __init__(self) -> None:
        """Begin in the middle of a line."""
        self._part = bytearray()
        self._skipping = True
        self.too_long = 0
        """Lines that were dropped for their length."""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes, and return the lines that they complete, without their ends."""
        *ended, rest = data.split(b"\n")
        lines: list[bytes] = []
        for piece in ended:
            self._add(piece)
            if not self._skipping:
                lines.append(bytes(self._part))
            self._part.clear()
            self._skipping = False
        self._add(rest)
        return lines

    def _add(self, piece: bytes) -> None:
        if self._skipping:
            return
        self._part += piece
        if len(self._part) > LONGEST:
            self._part.clear()
            self._skipping = True
            self.too_long += 1


class Decoder:
    """Reads what a board sends. No bytes make it raise."""

    def __init__(self) -> None:
        """Begin in the middle of a line."""
        self._lines = ELineSplitter()
        self._bad = 0

    @property
    def rejected(self) -> int:
        """Lines that were none of the protocol's; an incomplete first one is not counted."""
        return self._bad + self._lines.too_long

    def feed(self, data: bytes) -> list[Reading | Banner]:
        """Take bytes, and return what the lines that they complete say."""
        said: list[Reading | Banner] = []
        for line in self._lines.feed(data):
            decoded = decode(line)
            if decoded is None:
                self._bad += 1
            else:
                said.append(decoded)
        return said


class Requests:
    r"""Finds the host's questions, at the board: `?` alone on a line.

    A carriage return counts as the end of a line, for terminals that send one; a question is then
    answered once, the line feed behind it being an empty line.
    """

    def __init__(self) -> None:
        """Begin at the start of a line."""
        self._line = 0
        """0: nothing yet, 1: a question mark, 2: anything else."""

    def feed(self, data: bytes) -> int:
        """Take bytes, and return how many questions they complete."""
        asked = 0
        for byte in data:
            if byte in b"\r\n":
                asked += self._line == 1
                self._line = 0
            else:
                self._line = 1 if byte == ord("?") and self._line == 0 else 2
        return asked
