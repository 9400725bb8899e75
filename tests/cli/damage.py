"""Damaged files: single kinds of damage, and random mutations of any format that is read."""

import json
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from equipoise.artefacts import value_digest
from equipoise.errors import EquipoiseError

LONGEST = 5.0
"""Limit on the processor time to read one damaged file [s]; a sound one takes milliseconds."""
LONGEST_MESSAGE = 2000
"""Limit on the length of a refusal: a message does not quote a file."""

HOSTILE = (
    b"[" * 20_000,
    b"{" * 20_000,
    b"[a." + b"a." * 5_000 + b"a]",
    b"9" * 5_000,
    b"0x" + b"f" * 5_000,
    b"-1e15",
    b"1e308",
    b"1e999",
    b"nan",
    b"inf",
    b"\0",
    b"\x1b[2J",
    b"\xff\xfe",
    b"\xed\xa0\x80",
    b"\\ud800",
    b'"' + b"a" * 100_000 + b'"',
)
"""Pieces that parsers of text have stumbled over: nesting, long integers, extreme numbers, invalid
UTF-8, a surrogate, a long string."""


def rebuilt(path, change):
    """Change the body and write a digest that fits, as a program would that knows the format."""
    document = json.loads(path.read_text())
    change(document["body"])
    document["digest"] = digest(document["body"])
    path.write_text(json.dumps(document))


def digest(body):
    from pydantic import RootModel

    return value_digest(RootModel[dict](body))


def mutations(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """Yield damaged copies: flipped bits, cuts, pieces lost, doubled, overwritten or hostile.

    Args:
        data: A sound file.
        count: Number of copies.
        seed: Seed of the damage; equal seeds give equal copies.
    """
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


def outcomes(
    read: Callable[[Path], Any],
    path: Path,
    damaged: Iterator[bytes],
) -> Counter[str]:
    """Read damaged copies of a file; each is read as a value or refused in one sentence.

    Args:
        read: Reads the file.
        path: The file that is overwritten with each copy; its suffix is that of its format.
        damaged: The copies, for example from `mutations`.

    Returns:
        Number of copies that were `read` and that were `refused`.

    Raises:
        AssertionError: Any other exception, a message of several lines, or too much time.
    """
    found: Counter[str] = Counter()
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
            assert len(message) < LONGEST_MESSAGE, f"copy {i}: {message[:200]!r}..."
        except Exception as error:
            raise AssertionError(f"copy {i} ends with {error!r:.500}: {content[:300]!r}") from error
        took = time.process_time() - begin
        assert took < LONGEST, f"copy {i} takes {took:.1f} s"
    return found
