"""Rings of shared memory between the tick loop and the writer of the log.

The loop pushes rows; another process, or the same one between two ticks, takes them. A ring has one
writer and one reader and needs no lock. A full ring drops new rows and counts them.

The memory of a run in real time is a file without a disk behind it, in a folder that only this
user can enter. A console maps the same file: it reads rows without taking them, and writes to one
ring of words, so that the run never waits for an observer and cannot tell whether one is alive. Two
file locks, which the system releases when a process ends in any way, mark the run as alive and, on
the memory, its ring of words as taken by a console.
"""

import mmap
import os
import shutil
import stat
import tempfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.control.ticks import OperatorMessage, TickInputs, TickOutput
from equipoise.errors import OutsideError
from equipoise.files import lock, write_atomically
from equipoise.log.columns import tables, unknown_rows
from equipoise.log.conditions import RunConditions
from equipoise.outcomes import describe

RATES: Final[Mapping[str, float]] = {
    "tick": 100.0,
    "stream": 200.0,
    "reply": 250.0,
    "encoder": 2000.0,
    "event": 50.0,
}
"""Maximum rate of the rows of each recorded table [1/s]."""
EVENT: Final = tables(0)["event"]
"""Type of the rows of the table `event`."""
WORD: Final = np.dtype([("question", np.float64), ("word", "S64")])
"""Type of the rows with words of operators; those of a console name the time of the question that
they answer [s]."""
PULSE: Final = np.dtype([(name, np.float64) for name in ("time", "state", "phi", "ticks")])
"""Type of `Recorder.pulse`: time of the last tick [s], its state, phi [rad], number of ticks."""
CONNECTING: Final = "connecting"
"""Name of the events before a connection; a log with no other event is discarded."""
ENDED: Final = "ended"
"""Name of the event with the end of the run, for observers; a log holds the end itself."""
WORD_TYPED: Final = "word"
"""Name of the event with a word typed by the operator."""
FAILED: Final = "failed"
"""Name of the event with a failure reported by the loop."""


FOLDER: Final = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())
"""Folder for files without a disk on Linux; elsewhere that of temporary files."""
USER: Final = os.getuid() if hasattr(os, "getuid") else 0
"""Number of this user; 0 on Windows, as in the status of a file there."""
PREFIX: Final = f"equipoise-{USER}-"
"""Begin of the names of this user's runs."""


class Ring:
    """Ring of the rows of one table, with one writer and one reader."""

    def __init__(self, memory: Any) -> None:
        """Create a ring in existing memory: `rows`, and `counters` of those written, read, lost."""
        self._rows, self._counters = memory["rows"], memory["counters"]
        self._capacity, kind = len(self._rows), self._rows.dtype
        unknown = unknown_rows(kind, 1)[0].tolist()
        self._unknown: dict[str, Any] = dict(zip(kind.names or (), unknown, strict=True))

    def push(self, **values: Any) -> None:
        """Write a row; drop and count it if the ring is full.

        Args:
            values: Values of columns by their names; those left out, or None, are unknown.
        """
        counters = self._counters
        written = int(counters[0])
        if written - int(counters[1]) >= self._capacity:
            counters[2] += 1
            return
        self._rows[written % self._capacity] = tuple((self._unknown | values).values())
        counters[0] = written + 1  # after the row: the reader takes complete rows only

    def take(self) -> npt.NDArray[Any]:
        """Return the rows written since the last call."""
        written, read = int(self._counters[0]), int(self._counters[1])
        rows = self._rows[np.arange(read, written) % self._capacity]  # a copy
        self._counters[1] = written
        return rows

    def peek(self, since: int) -> tuple[npt.NDArray[Any], int]:
        """Return rows without taking them, for any number of observers.

        Of a ring only the newer half is returned: the writer does not reach it during the copy.

        Args:
            since: Number of rows seen before.

        Returns:
            The rows written since then, and the number of all rows written so far.
        """
        written = int(self._counters[0])
        first = max(since, written - self._capacity // 2)
        return self._rows[np.arange(first, written) % self._capacity], written

    @property
    def lost(self) -> int:
        """Number of dropped rows."""
        return int(self._counters[2])


class Recorder:
    """Shared memory: a ring per recorded table, the loop's pulse, and rings of the operators."""

    def __init__(self, joints: int, buffer: memoryview | bytearray | None = None) -> None:
        """Create the rings.

        Args:
            joints: Number of joints of the arm.
            buffer: Zeroed memory of the size of a `memory_layout`; allocated if not given.
        """
        layout = memory_layout(joints)
        buffer = bytearray(layout.itemsize) if buffer is None else buffer
        (memory,) = np.frombuffer(buffer, layout, 1)
        self.pulse: Any = memory["pulse"]
        """State of the loop at its last tick, as a row of the type `PULSE`."""
        self.rings: dict[str, Ring] = {name: Ring(memory[name]) for name in RATES}
        self.tick, self.stream, self.reply, self.encoder, self.event = self.rings.values()
        self.notices = Ring(memory["notices"])
        """Events for the operator, in another process."""
        self.typed = Ring(memory["typed"])
        """Words of the operator, from another process."""
        self.console = Ring(memory["console"])
        """Words from a console."""
        self._questions = Ring(memory["questions"])

    def record_tick(
        self, now: float, compute: float, inputs: TickInputs, output: TickOutput
    ) -> None:
        """Write the inputs, the decision and the messages of a tick, and update the pulse.

        Args:
            now: Time of the tick [s].
            compute: Computing time, from reading to sending [s].
            inputs: Inputs of the tick.
            output: Decision of the tick.
        """
        for sample in inputs.samples:
            self.encoder.push(**sample._asdict(), received=now)
        for reply in inputs.replies:
            measured = {"q": reply.q, "torque": reply.torque}
            self.reply.push(time=reply.received, sent=reply.sent, taken=now, **measured)
        self.tick.push(
            time=now,
            late=inputs.lateness,
            compute=compute,
            state=output.state,
            **output.record._asdict(),
            q=output.q,
            dq=output.dq,
        )
        for text in inputs.lines:
            push_event(self.event, now, OperatorMessage(WORD_TYPED, text))
        for fault in inputs.faults:
            push_event(self.event, now, OperatorMessage(FAILED, describe(fault)))
        for event in output.events:
            push_event(self.event, now, event)
        pulse = self.pulse
        pulse["time"], pulse["state"] = now, output.state
        pulse["phi"] = output.record.estimated_phi
        pulse["ticks"] += 1.0

    def take(self) -> dict[str, npt.NDArray[Any]]:
        """Return the rows of each table since the last call."""
        return {name: ring.take() for name, ring in self.rings.items()}

    def ask(self, question: OperatorMessage | None) -> None:
        """Publish the open question, which its time identifies; None withdraws it."""
        self._questions.take()  # the last one counts
        asked = question or OperatorMessage("")
        push_event(self._questions, asked.time, asked)

    def question(self) -> OperatorMessage | None:
        """Return the open question; None without one."""
        rows, _ = self._questions.peek(0)
        return next((asked for asked in read_events(rows[-1:]) if asked.answers), None)

    @property
    def lost(self) -> int:
        """Number of dropped rows of all tables."""
        return sum(ring.lost for ring in self.rings.values())


def memory_layout(joints: int) -> np.dtype[Any]:
    """Return the memory of a recorder: pulse, and the rings."""
    kinds = tables(joints)
    sizes = {name: (kinds[name], round(10.0 * rate)) for name, rate in RATES.items()}
    sizes |= {"notices": (EVENT, 256), "questions": (EVENT, 16)}
    sizes |= {"typed": (WORD, 256), "console": (WORD, 256)}
    rings = [
        (name, [("counters", np.int64, 3), ("rows", kind, size)])
        for name, (kind, size) in sizes.items()
    ]
    return np.dtype([("pulse", PULSE), *rings])


def push_event(ring: Ring, time: float, event: OperatorMessage) -> None:
    """Write an event into a ring, in UTF-8; truncate its texts to their columns."""
    columns = {"name": event.name, "answers": "|".join(event.answers), "text": event.text}
    texts = {name: text.encode(errors="backslashreplace") for name, text in columns.items()}
    ring.push(time=time, **texts)


def read_events(rows: npt.NDArray[Any]) -> list[OperatorMessage]:
    """Return the events in rows of the table `event`, with their times."""
    events: list[OperatorMessage] = []
    for time, *texts in rows.tolist():
        name, answers, text = (value.decode("utf-8", "ignore") for value in texts)
        words = tuple(filter(None, answers.split("|")))
        events.append(OperatorMessage(name, text, words, time))
    return events


# The memory of a run.


@contextmanager
def share(conditions: RunConditions) -> Generator[Path]:
    """Create the memory of a run, with its conditions for observers, and remove it at the end.

    Yields:
        The folder, for `open_recorder` in this process and in others.

    Raises:
        OutsideError: The memory cannot be created.
    """
    for leftover in _folders():
        if (leftover / "alive").exists() and not is_alive(leftover):  # its process was killed
            shutil.rmtree(leftover, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=FOLDER))
    try:
        with (folder / "alive").open("wb") as alive:
            lock(alive)
            size = memory_layout(len(conditions.joints)).itemsize
            try:
                (folder / "memory").write_bytes(bytes(size))  # not sparse: a full disk shows here
                # An observer waits for this file.
                write_atomically(folder / "run.json", conditions.model_dump_json())
            except OSError as error:
                message = f"cannot create {size} bytes of shared memory in {FOLDER}: {error}"
                raise OutsideError(message) from None
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def open_recorder(folder: Path) -> tuple[RunConditions, Recorder]:
    """Map the rings of a run into this process; return its conditions and the rings.

    Args:
        folder: Folder from `share`.

    Raises:
        OSError: The run has ended.
        ValueError: The run is one of another version of Equipoise.
    """
    conditions = RunConditions.model_validate_json((folder / "run.json").read_bytes(), strict=True)
    with (folder / "memory").open("r+b") as file:
        memory = memoryview(mmap.mmap(file.fileno(), 0))
    return conditions, Recorder(len(conditions.joints), memory)


def live_runs() -> list[Path]:
    """Return the folders of this user's runs on this machine, the newest first."""
    return [folder for folder in _folders() if is_alive(folder) and (folder / "run.json").exists()]


def _folders() -> list[Path]:
    """Return the folders of this user's runs, alive or not, the newest first."""
    folders: list[tuple[float, Path]] = []
    for folder in FOLDER.glob(f"{PREFIX}*"):
        with suppress(OSError):
            status = folder.lstat()
            private = stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077
            if private and status.st_uid == USER:
                folders.append((status.st_ctime, folder))
    return [folder for _, folder in sorted(folders, reverse=True)]


def is_alive(folder: Path) -> bool:
    """Return whether the process of a run is alive."""
    try:
        with (folder / "alive").open("rb") as file:
            return not lock(file)
    except OSError:
        return False
