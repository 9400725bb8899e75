"""Writer of run logs: rows become MCAP, in memory or in a file that grows with the run.

The log begins with a metadata record, which holds conditions and provenance. Rows follow as JSON,
compressed with zstd, in the order of time. The last message holds the end of the run.

A killed process leaves a file that `equipoise.log.run_log` reads up to its last chunk. A full disk
ends the log there and does not affect the tick loop.
"""

import heapq
import json
from collections.abc import Mapping
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, Final

from equipoise.errors import OutsideError
from equipoise.files import Provenance, temporary_name
from equipoise.log.columns import TABLES, Rows, schema, to_messages
from equipoise.log.conditions import RunConditions, RunEnd
from equipoise.log.recorder import CONNECTING, Recorder

FORMAT: Final = "equipoise-run"
CHUNK: Final = 128 * 1024
"""Size of a chunk before compression [B]: half a second of a run on a rig. A killed process loses
its last chunk."""


class LogEncoder:
    """Encoder of a run as the bytes of an MCAP file."""

    def __init__(
        self, stream: IO[bytes], conditions: RunConditions, provenance: Provenance, origin: float
    ) -> None:
        """Begin the log.

        Args:
            stream: Destination.
            conditions: Conditions of the run.
            provenance: Origin of the file.
            origin: Time of log time zero on the run's clock [s].
        """
        from mcap.writer import CompressionType, Writer

        self._origin, self._sequence = origin, 0
        self._writer = Writer(stream, CHUNK, CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="", library=FORMAT)
        entries = {
            "conditions": conditions.model_dump_json(),
            "provenance": provenance.model_dump_json(),
        }
        self._writer.add_metadata(FORMAT, entries)
        self._channels: dict[str, int] = {}
        for table in (*TABLES, "end"):
            data = json.dumps(schema(table)).encode()
            number = self._writer.register_schema(f"equipoise.{table}", "jsonschema", data)
            self._channels[table] = self._writer.register_channel(f"/{table}", "json", number)

    def write(self, rows_of: Mapping[str, Rows]) -> None:
        """Encode rows in the order of time.

        Rows of one table keep their order even if their times do not increase.
        """
        parts = [
            [(row["time"], name, row) for row in to_messages(rows)]
            for name, rows in rows_of.items()
        ]
        for time, name, row in heapq.merge(*parts, key=itemgetter(0)):
            self._add(name, time, row)

    def finish(self, time: float, end: RunEnd) -> None:
        """Encode the end of the run at `time` [s], and complete the file."""
        self._add("end", time, end.model_dump(mode="json", exclude_defaults=True))
        self._writer.finish()

    def _add(self, table: str, time: float, content: Mapping[str, Any]) -> None:
        stamp = max(round((time - self._origin) * 1e9), 0)
        data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[table], stamp, data, stamp, self._sequence)
        self._sequence += 1


class RunWriter:
    """File that grows with a run; it has its name from the first row after the connection on."""

    def __init__(self, path: Path, conditions: RunConditions, origin: float) -> None:
        """Begin the file under a temporary name, so that a run that fails to connect leaves none.

        Args:
            path: The file; an existing one is replaced.
            conditions: Conditions of the run.
            origin: Time of log time zero on the rig's clock [s].

        Raises:
            OutsideError: The disk rejects the file.
        """
        self._path, self._begun_path = path, temporary_name(path)
        self._connected = False
        self.problem: str | None = None
        """Reason of an early end of the log; None without a failure."""
        inputs = {"policy": conditions.policy, "actuator": conditions.actuator}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._begun_path.open("xb")
            provenance = Provenance.now("deploy", inputs)
            self._encoder = LogEncoder(self._file, conditions, provenance, origin)
            self._file.flush()
        except OSError as error:
            with suppress(OSError):
                self._begun_path.unlink()
            raise OutsideError(
                f"cannot write {path}: {error.strerror}; choose another path, or make room"
            ) from None

    def drain(self, recorder: Recorder) -> None:
        """Write the rows recorded since the last call; a failure of the disk sets `problem`."""
        rows = recorder.take()
        if self.problem is not None:
            return
        others = (len(table) for name, table in rows.items() if name != "event")
        names = rows["event"]["name"].tolist()
        try:
            if not self._connected and (any(others) or {*names} - {CONNECTING.encode()}):
                self._begun_path.replace(self._path)
                self._connected = True
            self._encoder.write(rows)
            self._file.flush()
        except OSError as error:
            self.problem = f"the disk takes no more ({error.strerror})"

    def finish(self, time: float, end: RunEnd) -> None:
        """Write the end of the run and close the file; a failure of the disk sets `problem`.

        Remove a file without rows after the connection.
        """
        try:
            if self._connected and self.problem is None:
                self._encoder.finish(time, end)
            self._file.close()
        except OSError as error:
            self.problem = self.problem or f"the disk takes no more ({error.strerror})"
        if not self._connected:
            self._begun_path.unlink(missing_ok=True)
