"""Reader of MCAP files of run logs, up to the first damage.

The reader walks the records from the front. It compares each length in the file with the rest of
the file and with a limit before it allocates memory. It accepts a chunk only with a matching
checksum, messages only with consecutive sequence numbers, and a metadata record only if its entries
match their checksum. The first damage ends the reading; the reader returns the records before it,
and a clause with the place and the kind of the damage.
"""

import io
import json
import logging
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from equipoise.errors import ArtefactError

logger = logging.getLogger(__name__)

MAGIC: Final = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""
CHUNK: Final = 128 * 1024
"""Size of a chunk before compression [B]: half a second of a run on a rig. A damaged byte costs its
chunk and all later ones."""
MAX_METADATA_SIZE: Final = 1 << 20
"""Limit on a metadata record [B]; those of run logs have 4 kB."""
MAX_CHUNK_SIZE: Final = 1 << 24
"""Limit on a chunk, before and after compression [B]; other writers use 1 to 4 MB."""
MAX_CONTENT_SIZE: Final = 1 << 31
"""Limit on the content of all chunks [B]: three times that of the longest run, an hour."""
MAX_NUMBER: Final = 1e9
"""Limit on times [s], counts and all other numbers in a row: clocks and encoders reach 1e8."""

RECORD: Final = struct.Struct("<BQ")
"""Head of a record: kind, and length of the body [B]."""
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
"""Head of a message: channel, sequence number, log time [ns], publish time [ns]."""
FOOTER, CHANNEL, MESSAGE, CHUNK_RECORD, METADATA, DATA_END = 0x02, 0x04, 0x05, 0x06, 0x0C, 0x0F
"""Kinds of records; the reader skips all others."""
LIMITS: Final[Mapping[int, int]] = {METADATA: MAX_METADATA_SIZE, CHUNK_RECORD: MAX_CHUNK_SIZE}
"""Size limits of the records that the reader loads [B], by kind."""
DATA_END_LENGTH: Final = 4
"""Length of the body of a data-end record [B]."""
OWN_KINDS: Final = 0x80
"""First kind that other programs may define; MCAP defines or reserves all kinds below."""
CHECKSUM: Final = "checksum"
"""Name of the entry of a metadata record that holds the CRC-32 of the other entries."""


class McapContent(NamedTuple):
    """The sound part of an MCAP file."""

    metadata: Mapping[str, Mapping[str, str]]
    """Entries of the metadata records, by the names of the records."""
    messages: Mapping[str, list[bytes]]
    """Messages in their order, by topic."""
    last: float
    """Log time of the last sound message [s]; zero without messages."""
    damage: str
    """Kind and place of the damage, as a clause; empty for a sound file."""


class _DamageError(Exception):
    """A record is damaged."""


def with_checksum(entries: Mapping[str, str]) -> dict[str, str]:
    """Return the entries of a metadata record with their checksum, which MCAP does not have."""
    return {**entries, CHECKSUM: _checksum(entries)}


def _checksum(entries: Mapping[str, str]) -> str:
    others = {name: text for name, text in entries.items() if name != CHECKSUM}
    return f"{zlib.crc32(json.dumps(others, sort_keys=True).encode()):08x}"


def read_mcap(path: Path, *, messages: bool = True) -> McapContent:
    """Return the sound part of an MCAP file.

    Args:
        path: The file.
        messages: Read the messages; otherwise only the metadata before the first chunk.

    Raises:
        ArtefactError: The file is missing, cannot be read, or is no MCAP file.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise ArtefactError(
                    f"{path} is not an MCAP file, or its beginning is damaged; give a file that "
                    "deploy wrote"
                )
            return _read(file, messages)
    except FileNotFoundError:
        raise ArtefactError(f"there is no file {path}; check the path") from None
    except OSError as error:
        raise ArtefactError(f"cannot read {path}: {error.strerror}") from None


def _read(file: BinaryIO, wanted: bool) -> McapContent:
    metadata: dict[str, Mapping[str, str]] = {}
    found = _Messages()
    offset, size = 0, os.fstat(file.fileno()).st_size
    damage = ""
    try:
        while True:
            offset = file.tell()
            kind, body = _record(file, size)
            if kind == DATA_END or (kind == CHUNK_RECORD and not wanted):
                break
            if kind == METADATA:
                metadata.update([_metadata(body)])
            elif kind == CHUNK_RECORD:
                found.add(_content(body, MAX_CONTENT_SIZE - found.bytes))
    except _DamageError as error:
        damage = f"{error} at byte {offset:,} of {size:,}"
        logger.debug("%s: %s", file.name, damage)
    return McapContent(metadata, found.by_topic, found.last, damage)


def _record(file: BinaryIO, size: int) -> tuple[int, bytes]:
    """Return kind and body of the next record; an empty body if the record is skipped."""
    head = file.read(RECORD.size)
    if len(head) < RECORD.size:
        raise _DamageError("is cut short")
    kind, length = RECORD.unpack(head)
    if length > size - file.tell():
        raise _DamageError("is cut short or damaged")
    if kind == DATA_END and length == DATA_END_LENGTH:
        return kind, b""
    if kind in (0, FOOTER) or DATA_END <= kind < OWN_KINDS:
        raise _DamageError("is damaged")
    limit = LIMITS.get(kind)
    if limit is None:
        file.seek(length, os.SEEK_CUR)
        return kind, b""
    if length > limit:
        raise _DamageError(f"claims a record of {length:,} bytes")
    return kind, file.read(length)


def _parsed(kind: Any, body: bytes) -> Any:
    """Return a record of the library from its body."""
    from mcap.data_stream import ReadDataStream

    try:
        return kind.read(ReadDataStream(io.BytesIO(body)))
    except Exception:  # a damaged length raises exceptions of any type
        raise _DamageError("is damaged") from None


def _metadata(body: bytes) -> tuple[str, Mapping[str, str]]:
    from mcap.records import Metadata

    record = _parsed(Metadata, body)
    entries = record.metadata
    if entries.get(CHECKSUM, _checksum(entries)) != _checksum(entries):
        raise _DamageError("is damaged in its header")
    return record.name, entries


def _content(body: bytes, limit: int) -> bytes:
    """Return the records in a chunk after validating their checksum."""
    from mcap.records import Chunk

    chunk = _parsed(Chunk, body)
    size: int = chunk.uncompressed_size
    if size > min(MAX_CHUNK_SIZE, limit):
        raise _DamageError(f"claims a chunk of {size:,} bytes")
    try:
        data = _decompressed(chunk.compression, chunk.data, size)
    except Exception:  # of two libraries
        raise _DamageError("is damaged") from None
    crc = chunk.uncompressed_crc
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise _DamageError("is damaged")
    return data


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    """Decompress at most `size` + 1 bytes: the claimed size may be wrong."""
    if compression == "":
        return data
    if compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_SIZE)
        return decompressor.stream_reader(data).read(size + 1)
    import lz4.frame

    return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)


class _Messages:
    """Messages by topic, with consecutive sequence numbers."""

    def __init__(self) -> None:
        self.by_topic: dict[str, list[bytes]] = {}
        self.last = 0.0
        self.bytes = 0
        self._topics: dict[int, list[bytes]] = {}
        self._count = 0

    def add(self, data: bytes) -> None:
        """Add the records of a chunk."""
        from mcap.records import Channel

        self.bytes += len(data)
        stream = io.BytesIO(data)
        while head := stream.read(RECORD.size):
            if len(head) < RECORD.size:
                raise _DamageError("is damaged")
            kind, length = RECORD.unpack(head)
            body = stream.read(min(length, len(data)))
            if len(body) < length:
                raise _DamageError("is damaged")
            if kind == CHANNEL:
                channel = _parsed(Channel, body)
                self._topics[channel.id] = self.by_topic.setdefault(channel.topic, [])
            elif kind == MESSAGE:
                self._message(body)

    def _message(self, body: bytes) -> None:
        if len(body) < MESSAGE_HEAD.size:
            raise _DamageError("is damaged")
        channel, sequence, log_time, _ = MESSAGE_HEAD.unpack_from(body)
        if sequence != self._count or channel not in self._topics:
            raise _DamageError("lacks messages before the chunk")
        self._topics[channel].append(body[MESSAGE_HEAD.size :])
        self._count += 1
        self.last = 1e-9 * log_time
