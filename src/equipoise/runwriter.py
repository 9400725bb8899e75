"""The log of a run on a rig, written while it runs.

The loop that moves the arm puts rows into a `Recorder`: rings of memory that were laid out before,
one for each table, without a lock. Whoever has the time for it (in real time a process of its own)
drains them into an MCAP file with the topics::

    /tick     100 a second    what was seen and decided, and how long that took
    /stream   200 a second    setpoints, as they were sent
    /reply    200 a second    what the arm answered
    /encoder  per sample      counts, with the faults that the board and the link met
    /event    rarely          changes of the state, prompts, faults, in words
    /end      once, last      how it ended

and a metadata record that says first what was to run, on which rig, under which settings.

Rows are JSON, compressed with zstd, and go to the disk chunk by chunk. After each chunk stands the
end of a valid MCAP file, written in the same breath; the next chunk overwrites it. A process that
is killed leaves a file that every reader takes, to its last chunk. A full disk ends the log, with
the file in that same order, and does not reach the loop: a ring that nobody drains drops its newest
rows and counts them.
"""

import io
import json
import logging
import math
import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import temporary_name
from equipoise.errors import ArtefactError, OutsideError
from equipoise.mcapfile import CHUNK, LARGEST_NUMBER, MAGIC, MOST_JOINTS, read_mcap, sealed

logger = logging.getLogger(__name__)

FORMAT: Final = "equipoise-rig-run"
VERSION: Final = 1

BUFFERED: Final = 10.0
"""So long a ring holds what nobody drains [s]."""
TALK: Final = 256
"""Events and words on their way between operator and loop."""
TEXT: Final = 400
"""Longest text of an event [B]."""
CONNECTING: Final = "connecting"
"""Name of the event before a connection; a log that holds nothing else is not kept."""

SCALAR: Final = "<f8"
WHOLE: Final = "<i8"
RATES: Final[Mapping[str, float]] = {
    "tick": 100.0,
    "stream": 200.0,
    "reply": 250.0,
    "encoder": 2000.0,
    "event": 50.0,
}
"""Most rows of each table in a second."""

EVENT: Final = (
    ("time", SCALAR),
    ("name", "S32"),
    ("answers", "S96"),
    ("text", f"S{TEXT}"),
)
"""Columns of an event: answers are words that are expected to be typed, with | between them."""
WORD: Final = (("word", "S64"),)
"""Columns of what an operator types."""

TAIL: Final = (
    struct.pack("<BQI", 0x0F, 4, 0)  # end of the data, without a checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # footer, without a summary
    + MAGIC
)
"""What makes an MCAP file whole that has no summary."""


def tables(joints: int) -> dict[str, np.dtype[Any]]:
    """Return the columns of each table, for an arm of so many joints.

    Times are those of the rig's clock [s]; angles are in radians, torques in newton metres. NaN
    stands for what is not known. `taken` of a reply and `received` of a count are the time of the
    tick that saw them first; the one reply that belongs to no setpoint is the posture at which the
    servo began.
    """
    posture = (SCALAR, (joints,))
    columns: dict[str, list[tuple[Any, ...]]] = {
        "tick": [
            ("time", SCALAR),
            ("late", SCALAR),
            ("compute", SCALAR),
            ("state", WHOLE),
            ("x", SCALAR),
            ("x_dot", SCALAR),
            ("phi", SCALAR),
            ("phi_dot", SCALAR),
            ("box", WHOLE),
            ("u", SCALAR),
            ("estimated_phi", SCALAR),
            ("estimated_phi_dot", SCALAR),
            ("bias", SCALAR),
            ("q", *posture),
            ("dq", *posture),
        ],
        "stream": [("time", SCALAR), ("q", *posture)],
        "reply": [
            ("time", SCALAR),
            ("sent", SCALAR),
            ("q", *posture),
            ("torque", *posture),
            ("taken", SCALAR),
        ],
        "encoder": [
            ("time", SCALAR),
            ("counts", WHOLE),
            ("pressed", WHOLE),
            ("illegal", WHOLE),
            ("missing", WHOLE),
            ("received", SCALAR),
        ],
        "event": list(EVENT),
    }
    return {name: np.dtype(fields) for name, fields in columns.items()}


class Ring:
    """Rows of one table on their way from the loop to the log; one end writes, one end reads."""

    def __init__(self, rows: npt.NDArray[Any], counters: npt.NDArray[np.int64]) -> None:
        """Use memory that exists.

        Args:
            rows: Room for the rows.
            counters: How many were written, read, and lost, shape (3,).
        """
        self._rows, self._counters, self._capacity = rows, counters, len(rows)

    def push(self, *row: Any) -> None:
        """Write a row; where there is no room it is lost, and counted."""
        counters = self._counters
        written = int(counters[0])
        if written - int(counters[1]) >= self._capacity:
            counters[2] += 1
            return
        self._rows[written % self._capacity] = row
        counters[0] = written + 1  # after the row: the reader takes what is complete

    def take(self) -> npt.NDArray[Any]:
        """Return what was written since the last call."""
        written, read = int(self._counters[0]), int(self._counters[1])
        which = np.arange(read, written) % self._capacity
        rows = self._rows[which]  # a copy
        self._counters[1] = written
        return rows

    @property
    def lost(self) -> int:
        """Rows that found no room."""
        return int(self._counters[2])


class Recorder:
    """What the loop writes into: a ring for each table, and how it is doing now."""

    def __init__(self, joints: int, buffer: memoryview | bytearray | None = None) -> None:
        """Lay the rings out.

        Args:
            joints: Joints of the arm.
            buffer: Memory for them, of the length that `room` says, zero at first.
        """
        buffer = bytearray(self.room(joints)) if buffer is None else buffer
        layout, place = tables(joints), 0
        names = list(layout)
        counters = np.frombuffer(buffer, np.int64, 3 * len(names), 0).reshape(-1, 3)
        place += counters.nbytes
        self.pulse: npt.NDArray[np.float64] = np.frombuffer(buffer, np.float64, len(PULSE), place)
        """When the last tick was, its state, the live angle: by the places in `PULSE`."""
        place += self.pulse.nbytes
        self.joints = joints
        self.unknown = (math.nan,) * joints
        """What stands for a posture that was not asked for."""
        self.rings: dict[str, Ring] = {}
        for number, (name, kind) in enumerate(layout.items()):
            length = _length(name)
            rows = np.frombuffer(buffer, kind, length, place)
            self.rings[name] = Ring(rows, counters[number])
            place += rows.nbytes
        self.tick, self.stream, self.reply, self.encoder, self.event = self.rings.values()
        talk = np.frombuffer(buffer, np.int64, 6, place).reshape(2, 3)
        place += talk.nbytes
        told = np.frombuffer(buffer, np.dtype(list(EVENT)), TALK, place)
        place += told.nbytes
        words = np.frombuffer(buffer, np.dtype(list(WORD)), TALK, place)
        self.told, self.words = Ring(told, talk[0]), Ring(words, talk[1])
        """To the operator, and back, where that is another process."""

    @staticmethod
    def room(joints: int) -> int:
        """Return how many bytes the rings of an arm of so many joints take."""
        layout = tables(joints)
        rows = sum(_length(name) * kind.itemsize for name, kind in layout.items())
        talk = TALK * (np.dtype(list(EVENT)).itemsize + np.dtype(list(WORD)).itemsize)
        return 3 * 8 * (len(layout) + 2) + 8 * len(PULSE) + rows + talk

    def forget(self) -> None:
        """Empty the rings of what nobody wants."""
        for ring in self.rings.values():
            ring.take()

    @property
    def lost(self) -> int:
        """Rows that found no room."""
        return sum(ring.lost for ring in self.rings.values())


PULSE: Final = ("time", "state", "phi", "ticks")
"""What `Recorder.pulse` holds: when the last tick was [s], its state, phi [rad], how many there
were."""


def _length(name: str) -> int:
    return round(RATES[name] * BUFFERED)


class _Block(io.RawIOBase):
    """Where MCAP's writer writes: what it has finished since the last look, and how far it is."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._place = 0

    def write(self, data: Any, /) -> int:
        self._parts.append(bytes(data))
        self._place += len(data)
        return len(data)

    def tell(self) -> int:
        return self._place

    def take(self) -> bytes:
        data = b"".join(self._parts)
        self._parts.clear()
        return data


class RunWriter:
    """An MCAP file that grows with a run; it is valid after each chunk."""

    def __init__(
        self,
        path: Path,
        joints: int,
        conditions: Mapping[str, Any],
        origin: float,
        replace: bool = False,
    ) -> None:
        """Begin the file.

        Args:
            path: The file.
            joints: Joints of the arm.
            conditions: What is to run, as JSON takes it.
            origin: Time of the rig's clock that log times count from [s].
            replace: Whether an existing file is replaced, by the first row after a connection.

        Raises:
            OutsideError: The file exists, or the disk refuses.
        """
        from mcap.writer import CompressionType, Writer

        self._path, self._origin, self._place = path, origin, 0
        self._at = temporary_name(path) if replace else path
        self._connected = False
        self._block, self._sequence = _Block(), 0
        self._layout = tables(joints)
        self.problem: str | None = None
        """Why the log ended early; none while all is well."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._at, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            raise OutsideError(
                f"cannot write {path}: it was made a moment ago; give the same command again"
            ) from None
        except OSError as error:
            raise OutsideError(
                f"cannot write {path}: {error.strerror}; give another place for the log"
            ) from None
        # A raw stream would be buffered by the writer, and not seen here in time.
        stream: Any = _Stream(self._block)
        self._writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=FORMAT)
        told = {"version": str(VERSION), "conditions": json.dumps(dict(conditions))}
        self._writer.add_metadata(FORMAT, sealed(told))
        self._channels: dict[str, int] = {}
        for topic, schema in _schemas(self._layout).items():
            text = json.dumps(schema).encode()
            number = self._writer.register_schema(f"equipoise{topic}", "jsonschema", text)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        self._write(self._block.take())
        if self.problem is not None:
            self._discard()
            raise OutsideError(f"cannot write {path}: {self.problem}; make room on the disk")

    def drain(self, recorder: Recorder) -> None:
        """Write what the loop has recorded since the last call. Never raises for the disk."""
        rows: list[tuple[float, str, dict[str, Any]]] = []
        for name, ring in recorder.rings.items():
            taken, kind = ring.take(), self._layout[name]
            if not len(taken):
                continue
            columns = [_plain(taken[column]) for column in kind.names or ()]
            names = kind.names or ()
            for row in zip(*columns, strict=True):
                rows.append((row[0] or 0.0, f"/{name}", dict(zip(names, row, strict=True))))
        rows.sort(key=lambda row: row[0])
        for time, topic, row in rows:
            if not self._connected and (topic != "/event" or row["name"] != CONNECTING):
                self._keep()
            self._add(topic, time, row)
            self._write(self._block.take())

    def finish(self, time: float, outcome: Mapping[str, Any]) -> None:
        """Say how it ended, and close the file. Never raises for the disk.

        A file without a row from after the connection is removed.
        """
        if not self._connected:
            self._discard()
            return
        self._add("/end", time, dict(outcome))
        if self.problem is None:
            self._writer.finish()
            self._write(self._block.take(), tail=b"")
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _keep(self) -> None:
        """Give the file its name: the rig is connected."""
        self._connected = True
        if self._at != self._path:
            try:
                self._at.replace(self._path)
            except OSError as error:
                self.problem = f"{self._path} cannot be replaced ({error.strerror})"

    def _discard(self) -> None:
        """Close and remove the file."""
        os.close(self._file)
        self._file = -1
        self._at.unlink(missing_ok=True)

    def _add(self, topic: str, time: float, row: dict[str, Any]) -> None:
        if self.problem is not None:
            return
        stamp = max(round((time - self._origin) * 1e9), 0)
        text = json.dumps(row, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], stamp, text, stamp, self._sequence)
        self._sequence += 1

    def _write(self, data: bytes, tail: bytes = TAIL) -> None:
        """Put finished records where the file's tail is, with a tail behind them."""
        if not data or self.problem is not None:
            return
        try:
            whole = data + tail
            if os.pwrite(self._file, whole, self._place) != len(whole):
                raise OSError(0, "no space left on device")
            if not tail:
                os.ftruncate(self._file, self._place + len(whole))
            self._place += len(data)
        except OSError as error:
            self.problem = f"the disk takes no more ({error.strerror})"
            self._restore()

    def _restore(self) -> None:
        """Close the file behind the last good chunk; its tail's place is on the disk already."""
        try:
            os.pwrite(self._file, TAIL, self._place)
            os.ftruncate(self._file, self._place + len(TAIL))
        except OSError:  # it was said already that the disk takes no more
            return


class _Stream:
    """The few methods that MCAP's writer asks of a stream."""

    def __init__(self, block: _Block) -> None:
        self.write, self.tell = block.write, block.tell

    def flush(self) -> None:
        """Do nothing: what is finished is taken at once."""


def _plain(column: npt.NDArray[Any]) -> list[Any]:
    """Return a column as JSON takes it: text as such, null for what is not known."""
    if column.dtype.kind == "S":
        return [text.decode("utf-8", "replace") for text in column.tolist()]
    if column.dtype.kind == "i" or bool(np.isfinite(column).all()):
        return column.tolist()
    return [_known(value) for value in column.tolist()]


def _known(value: Any) -> Any:
    if isinstance(value, list):
        return value if all(map(math.isfinite, value)) else None
    return value if math.isfinite(value) else None


def _schemas(layout: Mapping[str, np.dtype[Any]]) -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each topic; Foxglove needs one to plot."""

    def kind(column: np.dtype[Any]) -> dict[str, Any]:
        if column.subdtype is not None:
            return {"type": "array", "items": {"type": "number"}}
        return {"type": {"i": "integer", "S": "string"}.get(column.kind, "number")}

    schemas: dict[str, dict[str, Any]] = {}
    for name, columns in layout.items():
        properties = {column: kind(columns[column]) for column in columns.names or ()}
        schemas[f"/{name}"] = {"type": "object", "properties": properties}
    return schemas | {"/end": {"type": "object"}}


WORD_TYPED: Final = "word"
"""Name of the event that holds what an operator typed."""
FAILED: Final = "failed"
"""Name of the event that holds what the loop told the heart of a failure."""


class LoggedEvent(NamedTuple):
    """Something that happened in a run, in words."""

    time: float
    """When [s]."""
    name: str
    """One word: a state that has begun, or what is asked for."""
    answers: tuple[str, ...]
    """Words of which one is expected to be typed."""
    text: str
    """The sentence for a person."""


@dataclass(frozen=True)
class RigRun:
    """A log as it was read; of a run that was killed, to its last chunk."""

    conditions: Mapping[str, Any]
    """What was to run."""
    tables: Mapping[str, npt.NDArray[Any]]
    """Rows of `tick`, `stream`, `reply` and `encoder`, as structured arrays."""
    events: tuple[LoggedEvent, ...]
    """What happened, in order."""
    end: Mapping[str, Any] | None
    """How it ended; none where the log breaks off."""
    damage: str = ""
    """Where the file is damaged that these are the first rows of, as a clause; empty where it is
    sound, if only as far as it was written."""


def is_rig_run(path: Path) -> bool:
    """Return whether a file says that it is the log of a run on a rig."""
    try:
        return FORMAT in read_mcap(path, messages=False).metadata
    except ArtefactError:
        return False  # the reader of the other format says what is wrong


def read_rig_run(path: Path) -> RigRun:
    """Read the log of a run on a rig, as far as it goes.

    Raises:
        ArtefactError: The file is missing, or is no such log.
    """
    content = read_mcap(path)
    told, messages = content.metadata.get(FORMAT, {}), content.messages
    if "conditions" not in told:
        raise ArtefactError(f"{path} is no log of a run on a rig; give a file that deploy wrote")
    if told.get("version") != str(VERSION):
        raise ArtefactError(
            f"{path} has version {told.get('version', '')[:20]!r} of {FORMAT!r}, this Equipoise "
            f"reads {VERSION}; upgrade Equipoise"
        )
    try:
        conditions = json.loads(told["conditions"])
        joints = conditions["joints"]
        if not (isinstance(joints, int) and 1 <= joints <= MOST_JOINTS):
            raise ValueError(joints)
        rows = {
            name: _array([json.loads(text) for text in messages.get(f"/{name}", [])], kind)
            for name, kind in tables(joints).items()
            if name != "event"
        }
        events = tuple(_event(json.loads(text)) for text in messages.get("/event", []))
        end = json.loads(messages["/end"][-1]) if messages.get("/end") else None
        if end is not None and not isinstance(end, dict):
            raise TypeError(end)
    except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError):
        raise ArtefactError(
            f"{path} is not a valid {FORMAT!r} file: its rows are incomplete; record it again"
        ) from None
    return RigRun(conditions, rows, events, end, content.damage if end is None else "")


def _event(row: Mapping[str, Any]) -> LoggedEvent:
    time = float(row["time"])
    if not abs(time) <= LARGEST_NUMBER:
        raise ValueError(time)
    return LoggedEvent(time, str(row["name"]), _words(row["answers"]), str(row["text"]))


def _words(answers: str) -> tuple[str, ...]:
    return tuple(word for word in answers.split("|") if word)


def push_event(ring: Ring, time: float, name: str, answers: Sequence[str], text: str) -> None:
    """Write an event into a ring, cut where it is too long."""
    encoded = text.encode(errors="backslashreplace")
    ring.push(time, name.encode()[:32], "|".join(answers).encode()[:96], encoded[:TEXT])


def take_events(ring: Ring) -> list[LoggedEvent]:
    """Return the events that were written into a ring since the last call."""
    return [
        LoggedEvent(
            float(row["time"]),
            row["name"].decode(),
            _words(row["answers"].decode()),
            row["text"].decode("utf-8", "ignore"),
        )
        for row in ring.take()
    ]


def _array(rows: Sequence[Mapping[str, Any]], kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return rows as a structured array, NaN where something is not known.

    Raises:
        ValueError: A number is none that a run can have.
    """
    made = np.zeros(len(rows), kind)
    for name in kind.names or () if rows else ():
        unknown = np.full(kind[name].shape, np.nan) if kind[name].base.kind == "f" else 0
        made[name] = [unknown if row[name] is None else row[name] for row in rows]
        if np.any(np.abs(made[name]) > LARGEST_NUMBER) or (
            name == "time" and np.isnan(made[name]).any()
        ):
            raise ValueError(name)
    return made
