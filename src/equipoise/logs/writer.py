"""Writer of run logs: rows become MCAP, in memory or in a file that grows with the run.

The log begins with a metadata record: conditions, provenance and the clock's time at log time zero.
Rows follow as JSON, compressed with zstd, in the order of time. The last message holds the end of
the run and a digest of conditions, rows and end.

`RunWriter` writes each finished chunk to the disk, followed by the end of a valid MCAP file, which
the next chunk overwrites. So a killed process leaves a valid file up to its last chunk. A full disk
ends the log in a valid state and does not affect the tick loop.
"""

import hashlib
import heapq
import io
import json
import os
import struct
from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from equipoise.artefacts import DIGEST_PREFIX, Provenance, temporary_name
from equipoise.errors import OutsideError
from equipoise.logs.conditions import RunConditions, RunEnd
from equipoise.logs.container import CHUNK, MAGIC, with_checksum
from equipoise.logs.foxglove import SCHEMAS, ArmDisplay
from equipoise.logs.layout import TABLES, Rows, canonical, schema, to_messages
from equipoise.logs.recorder import CONNECTING, Recorder
from equipoise.model.arms.urdf_writer import PENDULUM

FORMAT: Final = "equipoise-run"
VERSION: Final = 3

TAIL: Final = (
    struct.pack("<BQI", 0x0F, 4, 0)  # data end, without a checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # footer, without a summary
    + MAGIC
)
"""Bytes that complete an MCAP file without a summary."""


class Digest:
    """SHA-256 of conditions, rows and end; each table has its own hash of its rows."""

    def __init__(self, conditions: RunConditions) -> None:
        """Begin with the conditions."""
        self._head = canonical_json(conditions.model_dump(mode="json"))
        self._tables = {name: hashlib.sha256() for name in TABLES}

    def update(self, table: str, rows: Rows) -> None:
        """Add canonical rows of a table."""
        self._tables[table].update(rows.tobytes())

    def finish(self, end: RunEnd | None) -> str:
        """Return the digest of the added rows and the end."""
        whole = hashlib.sha256(self._head)
        for name, rows in self._tables.items():
            whole.update(name.encode() + rows.digest())
        whole.update(canonical_json(end and end.model_dump(mode="json")))
        return DIGEST_PREFIX + whole.hexdigest()


def canonical_json(content: Any) -> bytes:
    """Return content as JSON without blanks, keys in order."""
    return json.dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()


class LogEncoder:
    """Encoder of a run as the bytes of an MCAP file."""

    def __init__(self, conditions: RunConditions, provenance: Provenance, origin: float) -> None:
        """Begin the log.

        Args:
            conditions: Conditions of the run.
            provenance: Origin of the file.
            origin: Time of log time zero on the run's clock [s].
        """
        from mcap.writer import CompressionType, Writer

        self._buffer, self._origin, self._sequence = _Buffer(), origin, 0
        self._digest = Digest(conditions)
        self._display = ArmDisplay(conditions.arm)
        self._writer = Writer(self._buffer, CHUNK, CompressionType.ZSTD)
        self._writer.start(profile="", library=FORMAT)
        entries = {
            "version": str(VERSION),
            "conditions": conditions.model_dump_json(),
            "provenance": provenance.model_dump_json(),
            "origin": repr(float(origin)),
        }
        self._writer.add_metadata(FORMAT, with_checksum(entries))
        urdf = self._display.urdf.encode()
        self._writer.add_attachment(0, 0, f"{PENDULUM}.urdf", "application/xml", urdf)
        self._channels: dict[str, int] = {}
        for topic, name, content in _topics():
            data = json.dumps(content).encode()
            number = self._writer.register_schema(name, "jsonschema", data)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)

    def write(self, rows_of: Mapping[str, Rows]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Encode rows in the order of time; yield topic and content of each message.

        Rows of one table keep their order even if their times do not increase.
        """
        parts: list[list[tuple[float, str, dict[str, Any]]]] = []
        for name, given in rows_of.items():
            rows = canonical(given)
            self._digest.update(name, rows)
            parts.append([(row["time"], name, row) for row in to_messages(rows)])
        for time, name, row in heapq.merge(*parts, key=itemgetter(0)):
            self._add(f"/{name}", time, row)
            stamp = self._stamp(time)
            for topic, message in self._display.messages(name, row, stamp):
                self._add(topic, time, message)
            yield name, row

    def finish(self, time: float, end: RunEnd) -> None:
        """Encode the end of the run at `time` [s], and complete the file."""
        content = end.model_dump(mode="json", exclude_defaults=True)
        self._add("/end", time, content | {"digest": self._digest.finish(end)})
        self._writer.finish()

    def take(self) -> bytes:
        """Return the bytes completed since the last call."""
        return self._buffer.take()

    def _stamp(self, time: float) -> int:
        return max(round((time - self._origin) * 1e9), 0)

    def _add(self, topic: str, time: float, content: Mapping[str, Any]) -> None:
        stamp = self._stamp(time)
        data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], stamp, data, stamp, self._sequence)
        self._sequence += 1


def _topics() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield topic, name of the schema, and schema of each channel."""
    for table in TABLES:
        yield f"/{table}", f"equipoise.{table}", schema(table)
    yield "/end", "equipoise.end", {"type": "object", "properties": {}}
    for topic, (name, content) in SCHEMAS.items():
        yield topic, name, content


class _Buffer(io.BytesIO):
    """Stream of complete records; `tell` includes the records that were taken."""

    _taken = 0

    def tell(self) -> int:
        return self._taken + super().tell()

    def take(self) -> bytes:
        data = self.getvalue()
        self._taken += len(data)
        self.seek(0)
        self.truncate()
        return data


class RunWriter:
    """File that grows with a run; it is a valid MCAP file after each chunk."""

    def __init__(
        self,
        path: Path,
        conditions: RunConditions,
        origin: float,
        replace: bool = False,
        command: str = "deploy",
    ) -> None:
        """Begin the file.

        Args:
            path: The file.
            conditions: Conditions of the run.
            origin: Time of log time zero on the rig's clock [s].
            replace: Replace an existing file, with the first row after the connection.
            command: Command or function that creates the run.

        Raises:
            OutsideError: The file exists, or the disk rejects it.
        """
        self._path, self._offset = path, 0
        self._current_path = temporary_name(path) if replace else path
        self._connected = False
        self.problem: str | None = None
        """Reason of an early end of the log; None without a failure."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._current_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            raise OutsideError(
                f"cannot write {path}: it was created a moment ago; give the same command again"
            ) from None
        except OSError as error:
            reason = f"{error.strerror}; choose another path for the log"
            raise OutsideError(f"cannot write {path}: {reason}") from None
        inputs = {"policy": conditions.policy, "actuator": conditions.actuator}
        self._encoder = LogEncoder(conditions, Provenance.now(command, inputs), origin)
        self._write(self._encoder.take())
        if self.problem is not None:
            self._discard()
            raise OutsideError(f"cannot write {path}: {self.problem}; make room on the disk")

    def drain(self, recorder: Recorder) -> None:
        """Write the rows recorded since the last call; a failure of the disk sets `problem`."""
        taken = {name: ring.take() for name, ring in recorder.rings.items()}
        if self.problem is not None:
            return
        for name, row in self._encoder.write(taken):
            if not self._connected and (name != "event" or row["name"] != CONNECTING):
                self._keep()
            self._write(self._encoder.take())

    def finish(self, time: float, end: RunEnd) -> None:
        """Write the end of the run and close the file; a failure of the disk sets `problem`.

        Remove a file without rows after the connection.
        """
        if not self._connected:
            self._discard()
            return
        if self.problem is None:
            self._encoder.finish(time, end)
            self._write(self._encoder.take(), tail=b"")
        os.close(self._file)

    def _keep(self) -> None:
        """Rename the temporary file to its final name after the connection."""
        self._connected = True
        if self._current_path != self._path:
            try:
                self._current_path.replace(self._path)
            except OSError as error:
                self.problem = f"{self._path} cannot be replaced ({error.strerror})"

    def _discard(self) -> None:
        """Close and remove the file."""
        os.close(self._file)
        self._current_path.unlink(missing_ok=True)

    def _write(self, data: bytes, tail: bytes = TAIL) -> None:
        """Write complete records over the file's tail, followed by a new tail."""
        if not data or self.problem is not None:
            return
        try:
            whole = data + tail
            if os.pwrite(self._file, whole, self._offset) != len(whole):
                raise OSError(0, "no space left on device")
            if not tail:
                os.ftruncate(self._file, self._offset + len(whole))
            self._offset += len(data)
        except OSError as error:
            self.problem = f"the disk takes no more ({error.strerror})"
            self._restore()

    def _restore(self) -> None:
        """Restore the tail after the last complete chunk, in space that is already allocated."""
        try:
            os.pwrite(self._file, TAIL, self._offset)
            os.ftruncate(self._file, self._offset + len(TAIL))
        except OSError:  # `problem` holds the first failure
            return
