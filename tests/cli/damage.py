"""Damaged files: single kinds of damage, and random mutations of any format that is read."""

import random
import time
from collections import Counter

from equipoise.errors import EquipoiseError

LONGEST = 5.0
"""Limit on the processor time to read one damaged file [s]; a sound one takes milliseconds."""

HOSTILE = (
    b"[" * 20_000, b"{" * 20_000, b"[a." + b"a." * 5_000 + b"a]", b"9" * 5_000,
    b"0x" + b"f" * 5_000, b"-1e15", b"1e308", b"1e999", b"nan", b"inf", b"\0", b"\x1b[2J",
    b"\xff\xfe", b"\xed\xa0\x80", b"\\ud800", b'"' + b"a" * 100_000 + b'"',
)  # fmt: skip
"""Pieces that parsers of text have stumbled over: nesting, long integers, extreme numbers, invalid
UTF-8, a surrogate, a long string."""


def mutations(data, count, seed=0):
    """Yield damaged copies: flipped bits, cuts, pieces lost, doubled, overwritten or hostile."""
    draw = random.Random(seed)
    for i in range(count):
        at = draw.randrange(len(data))
        end = min(at + draw.choice((1, 2, 8, 64, 512)), len(data))
        match i % 8:
            case 0 | 1:
                yield data[:at] + bytes([data[at] ^ (1 << draw.randrange(8))]) + data[at + 1 :]
            case 2:
                yield data[:at]
            case 3:
                yield data[:at] + data[end:]
            case 4:
                yield data[:end] + data[at:]
            case 5 | 6:
                yield data[:at] + draw.choice(HOSTILE) + data[end:]
            case _:
                yield data[:at] + draw.randbytes(end - at) + data[end:]


def outcomes(read, path, damaged):
    """Read damaged copies of a file; return how many were `read` and how many `refused`.

    Each is read as a value or refused in one sentence; anything else fails.
    """
    found = Counter()
    for i, content in enumerate(damaged):
        path.write_bytes(content)
        begin = time.process_time()
        try:
            read(path)
            found["read"] += 1
        except EquipoiseError as error:
            found["refused"] += 1
            message = str(error)
            assert message, f"copy {i}: a refusal without a word"
            assert "\n" not in message, f"copy {i}: several lines: {message!r}"
            assert len(message) < 2000, f"copy {i} is quoted: {message[:200]!r}..."
        except Exception as error:
            raise AssertionError(f"copy {i} ends with {error!r:.500}: {content[:300]!r}") from error
        took = time.process_time() - begin
        assert took < LONGEST, f"copy {i} takes {took:.1f} s"
    return found
