"""Rings of shared memory between the tick loop and the writer of the log.

The loop pushes rows; another process, or the same one between two ticks, takes them. A ring has one
writer and one reader and needs no lock. A full ring drops new rows and counts them.
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.control.ticks import OperatorMessage, TickInputs, TickOutput
from equipoise.logs.columns import TABLES, LoggedTick, tables, unknown_rows
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


class LoggedEvent(NamedTuple):
    """A change of the phase, a prompt or a fault, as text."""

    time: float
    """Time on the run's clock [s]."""
    name: str
    """Name of the phase that began, or kind of message."""
    answers: tuple[str, ...]
    """Words expected from the operator: one of them."""
    text: str
    """Sentence for the operator."""


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
            buffer: Zeroed memory of `buffer_size` bytes; allocated if not given.
        """
        layout = _memory_layout(joints)
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
        self._question: npt.NDArray[Any] = memory["question"]

    @staticmethod
    def buffer_size(joints: int) -> int:
        """Return the size of the memory for an arm with `joints` joints [B]."""
        return _memory_layout(joints).itemsize

    def record_tick(
        self, now: float, compute: float, inputs: TickInputs, output: TickOutput
    ) -> None:
        """Write the inputs and the decision of a tick, and update the pulse.

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
        tick = LoggedTick(now, compute, inputs, output)
        self.tick.push(**{column.name: column.value(tick) for column in TABLES["tick"]})
        for text in inputs.lines:
            push_event(self.event, now, OperatorMessage(WORD_TYPED, text))
        for fault in inputs.faults:
            push_event(self.event, now, OperatorMessage(FAILED, describe(fault)))
        pulse = self.pulse
        pulse["time"], pulse["state"] = now, output.state
        pulse["phi"] = output.record.estimated_phi
        pulse["ticks"] += 1.0

    def take(self) -> dict[str, npt.NDArray[Any]]:
        """Return the rows of each table since the last call."""
        return {name: ring.take() for name, ring in self.rings.items()}

    def ask(self, time: float, question: OperatorMessage | None) -> None:
        """Publish the open question, which its time [s] identifies; None without one."""
        row = self._question
        row["time"] = 0.0  # an observer ignores a row that is being written
        if question is not None:
            for name, text in _texts(question).items():
                row[name] = text
            row["time"] = time

    def question(self) -> LoggedEvent | None:
        """Return the open question; None without one."""
        (question,) = read_events(self._question.copy())
        open_ = question.time == self._question["time"][0] != 0.0
        return question if open_ else None

    @property
    def lost(self) -> int:
        """Number of dropped rows of all tables."""
        return sum(ring.lost for ring in self.rings.values())


def _memory_layout(joints: int) -> np.dtype[Any]:
    """Return the memory of a recorder: pulse, open question, and the rings."""
    kinds = tables(joints)
    sizes = {name: (kinds[name], round(10.0 * rate)) for name, rate in RATES.items()}
    sizes |= {"notices": (EVENT, 256), "typed": (WORD, 256), "console": (WORD, 256)}
    rings = [
        (name, [("counters", np.int64, 3), ("rows", kind, size)])
        for name, (kind, size) in sizes.items()
    ]
    return np.dtype([("pulse", PULSE), ("question", EVENT, 1), *rings])


def push_event(ring: Ring, time: float, event: OperatorMessage) -> None:
    """Write an event into a ring; truncate its texts to their columns."""
    ring.push(time=time, **_texts(event))


def read_events(rows: npt.NDArray[Any]) -> list[LoggedEvent]:
    """Return the events in rows of the table `event`."""
    events: list[LoggedEvent] = []
    for time, *texts in rows.tolist():
        name, answers, text = (value.decode("utf-8", "ignore") for value in texts)
        events.append(LoggedEvent(time, name, tuple(filter(None, answers.split("|"))), text))
    return events


def _texts(event: OperatorMessage) -> dict[str, bytes]:
    """Return the texts of an event by their columns, in UTF-8."""
    columns = {"name": event.name, "answers": "|".join(event.answers), "text": event.text}
    return {name: text.encode(errors="backslashreplace") for name, text in columns.items()}
