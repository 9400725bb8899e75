r"""Codec of the E-line protocol between an encoder board and the host.

The board sends a line in each period of its rate, and a banner at its start and on request::

    E,<seq>,<t_us>,<counts>,<flags>*<crc>\n        E,1023,123456789,-4096,1*1D\n
    I,<name>,<firmware>,<counts per rev>,<rate in Hz>*<crc>\n

The host requests the banner with `?\n`. The checksum is CRC-8/MAXIM over all bytes before the star.
The grammar is strict: each number has one spelling (no plus, leading zero, blank or -0), the
checksum is in capitals, a line ends with one line feed. Every change of a line within eight
neighbouring bits is therefore detected: before the star by the polynomial, after it (star,
checksum, line feed) because only one spelling is valid. See `docs/reference/e-line.md`.
"""

import re
from enum import IntFlag
from typing import Final, NamedTuple

REQUEST: Final = b"?\n"
"""Request for a board's banner."""
MAX_LINE: Final = 96
"""Maximum length of a line without its end [bytes]; every banner is shorter."""

_READING: Final = re.compile(
    rb"E,(0|[1-9][0-9]{0,4}),(0|[1-9][0-9]{0,9}),(0|-?[1-9][0-9]{0,9}),([0-9A-F])\*([0-9A-F]{2})"
)
_BANNER: Final = re.compile(
    rb"I,([A-Za-z][A-Za-z0-9_-]{0,31}),([A-Za-z0-9][A-Za-z0-9._-]{0,15}),"
    rb"([1-9][0-9]{0,8}),([1-9][0-9]{0,5})\*([0-9A-F]{2})"
)


class Flags(IntFlag):
    """Flags of a line."""

    DOWN = 1
    """The button is down."""
    PRESSED = 2
    """The button was pressed since the line before, even if it is up again."""
    INDEX = 4
    """The index of the encoder was passed since the line before."""
    ILLEGAL = 8
    """Both lines of the encoder changed at once since the line before: a count was lost."""


class Reading(NamedTuple):
    """Line of the encoder, in the units of the wire."""

    seq: int
    """Index of the period since the board started, modulo 2^16."""
    t_us: int
    """Time of the count on the board's clock, modulo 2^32 [us]."""
    counts: int
    """Counts after x4 since the board started, from -2^31 to 2^31 - 1."""
    flags: int
    """See `Flags`, 0 to 15."""


class Banner(NamedTuple):
    """Identification of a board."""

    name: str
    """Name: a letter, then up to 31 letters, digits, _ or -."""
    firmware: str
    """Version of its program: up to 16 letters, digits, dots, _ or -."""
    counts_per_rev: int
    """Counts per revolution, after x4."""
    rate_hz: int
    """Line rate [Hz]."""


def _crc_of_byte(crc: int) -> int:
    for _ in range(8):
        crc = crc >> 1 ^ (0x8C if crc & 1 else 0)
    return crc


_CRC: Final = bytes(map(_crc_of_byte, range(256)))


def crc8(data: bytes) -> int:
    """Return the CRC-8/MAXIM of bytes: polynomial 0x31, least significant bit first, from zero.

    Example:
        >>> hex(crc8(b"123456789"))
        '0xa1'
    """
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def encode(line: Reading | Banner) -> bytes:
    r"""Return the bytes of a line, including its end; its values have to fit their fields.

    Example:
        >>> encode(Reading(1023, 123456789, -4096, 1))
        b'E,1023,123456789,-4096,1*1D\n'
    """
    if isinstance(line, Reading):
        body = b"E,%d,%d,%d,%X" % line
    else:
        body = "I,{},{},{},{}".format(*line).encode()
    return b"%s*%02X\n" % (body, crc8(body))


def decode(line: bytes) -> Reading | Banner | None:
    """Decode a line without its end; return None for an invalid line."""
    match = _READING.fullmatch(line) or _BANNER.fullmatch(line)
    if match is None or crc8(line[:-3]) != int(match[5], 16):
        return None
    if match.re is _BANNER:
        return Banner(match[1].decode(), match[2].decode(), int(match[3]), int(match[4]))
    reading = Reading(int(match[1]), int(match[2]), int(match[3]), int(match[4], 16))
    fits = reading.seq < 2**16 and reading.t_us < 2**32 and -(2**31) <= reading.counts < 2**31
    return reading if fits else None


class Decoder:
    """Decoder of a board's byte stream; never raises.

    Bytes before the first line end are dropped, since reading usually starts within a line. Lines
    longer than `MAX_LINE` are dropped, so that memory is bounded.
    """

    def __init__(self) -> None:
        """Start within a line."""
        self._rest, self._skipping = b"", True
        self.rejected = 0
        """Number of invalid lines; an incomplete first line is not counted."""

    def feed(self, data: bytes) -> list[Reading | Banner]:
        """Add bytes, and return the contents of the lines that they complete."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if lines and self._skipping:
            del lines[0]
            self._skipping = False
        contents = [decode(line) for line in lines]
        valid = [content for content in contents if content is not None]
        self.rejected += len(contents) - len(valid)
        if len(self._rest) > MAX_LINE:
            self.rejected += not self._skipping
            self._rest, self._skipping = b"", True
        return valid


def count_requests(data: bytes) -> tuple[int, bytes]:
    r"""Return the number of requests of a host, and the incomplete rest.

    A request is `?` alone on a line. A carriage return also ends a line, for terminals that send
    one. The line feed behind it is then an empty line, so that the request is answered once.

    Args:
        data: The rest of the last call, and the bytes received since.
    """
    *lines, rest = data.replace(b"\r", b"\n").split(b"\n")
    return lines.count(b"?"), rest[:2]  # two bytes already make it no request
