"""Tables of a run log: name, type, unit and meaning of each column.

A table is a structured array with one row per message of the topic with its name::

    tick     100 Hz          the policy's observation and command, and the timing of the loop
    truth    100 Hz          the real state; in simulation only
    stream   200 Hz          setpoints as sent
    reply    200 Hz          joint positions or torques as measured
    encoder  up to 1 kHz     counts, and faults of board and link
    event    rarely          changes of the phase, prompts and faults, as text

Times are those of the run's clock [s]: on a rig its monotonic clock, in simulation the time since
the release. NaN represents an unknown number; the message omits its field.

Rings, messages, JSON schemas, files and CSV tables follow from `TABLES`. The record of a control
step is `equipoise.control.ticks.TickRecord`: each of its fields is a column of `tick`.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, get_type_hints

import numpy as np
import numpy.typing as npt

from equipoise.control.ticks import TickRecord

Rows = npt.NDArray[Any]
"""Rows of a table, as a structured array."""
MAX_NUMBER: Final = 1e12
"""Limit on times [s], counts and all other numbers in a row: a board's counts begin anywhere in 32
bits and go on beyond them; products of numbers within it stay finite."""


class Column(NamedTuple):
    """A column of a table."""

    name: str
    """Name of the field in messages."""
    kind: str
    """Type: `number`, `whole`, `joints` (one number per joint) or `S` with a size [B] (text)."""
    unit: str
    """Unit; empty without one."""
    description: str
    """Meaning, with sign or reference."""

    @property
    def header(self) -> str:
        """Name with unit, for the header of a CSV file."""
        unit = self.unit.replace("/", "_").replace("^", "").replace(" ", "")
        return f"{self.name}_{unit}" if unit else self.name


def _record_columns() -> Iterator[Column]:
    """Yield the columns of a control step's record, from the annotations of its fields."""
    for name, hint in get_type_hints(TickRecord, include_extras=True).items():
        kind = "whole" if hint.__origin__ is int else "number"
        yield Column(name, kind, *hint.__metadata__)


TABLES: Final[Mapping[str, tuple[Column, ...]]] = {
    "tick": (
        Column("time", "number", "s", "Start of the tick"),
        Column("late", "number", "s", "Delay of the start behind its deadline; on a rig"),
        Column("compute", "number", "s", "Computing time, from reading to sending; on a rig"),
        Column("state", "whole", "", "Phase, by its index in `phases` of the conditions"),
        *_record_columns(),
        Column("q", "joints", "rad", "Joint positions commanded for the end of the tick"),
        Column("dq", "joints", "rad/s", "Joint velocities commanded for the end of the tick"),
    ),
    "truth": (
        Column("time", "number", "s", "Start of the tick"),
        Column("x", "number", "m", "Displacement of the flange from home along base x"),
        Column("x_dot", "number", "m/s", "Velocity of the flange"),
        Column("phi", "number", "rad", "Angle of the pendulum from upright, towards +x"),
        Column("phi_dot", "number", "rad/s", "Angular velocity of the pendulum"),
        Column("tracked", "number", "m/s^2", "Acceleration of the flange over the tick"),
        Column("q", "joints", "rad", "Joint positions"),
    ),
    "stream": (
        Column("time", "number", "s", "Time of sending"),
        Column("q", "joints", "rad", "Setpoints of the joints"),
    ),
    "reply": (
        Column("time", "number", "s", "Time of arrival"),
        Column("sent", "number", "s", "Time of the request; unknown of the posture at the start"),
        Column("q", "joints", "rad", "Measured joint positions"),
        Column("torque", "joints", "N m", "Measured external torques"),
        Column("taken", "number", "s", "Tick that took the reply; on a rig"),
    ),
    "encoder": (
        Column("time", "number", "s", "Time stamp of the sample"),
        Column("counts", "whole", "", "Counts; in simulation from the zero"),
        Column("pressed", "whole", "", "1 while the button is pressed"),
        Column("illegal", "whole", "", "1 where the board saw an illegal transition"),
        Column("missing", "whole", "", "Number of lines lost before this one"),
        Column("received", "number", "s", "Tick that took the sample; on a rig"),
    ),
    "event": (
        Column("time", "number", "s", "Time"),
        Column("name", "S32", "", "Phase that began, or kind of message"),
        Column("answers", "S96", "", "Words expected from the operator, separated by |"),
        Column("text", "S400", "", "Sentence for the operator"),
    ),
}
"""Columns of each table."""


def tables(joints: int) -> dict[str, np.dtype[Any]]:
    """Return the type of the rows of each table, for an arm with `joints` joints."""
    types: dict[str, Any] = {"number": ["<f8"], "whole": ["<i8"], "joints": ["<f8", (joints,)]}
    return {
        name: np.dtype([(c.name, *types.get(c.kind, [c.kind])) for c in columns])
        for name, columns in TABLES.items()
    }


def schema(table: str) -> dict[str, Any]:
    """Return the JSON schema of the messages of a table; Foxglove needs one to plot."""
    kinds: dict[str, dict[str, Any]] = {
        "number": {"type": "number"},
        "whole": {"type": "integer"},
        "joints": {"type": "array", "items": {"type": "number"}},
    }
    properties = {
        c.name: kinds.get(c.kind, {"type": "string"})
        | {"description": f"{c.description} [{c.unit}]" if c.unit else c.description}
        for c in TABLES[table]
    }
    return {"type": "object", "properties": properties}


def canonical(rows: Rows) -> Rows:
    """Return rows with NaN in place of numbers beyond `MAX_NUMBER` and incomplete postures."""
    rows = rows.copy()
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.dtype.kind == "f":
            known = np.abs(column) <= MAX_NUMBER
            column[~(known.all(axis=1) if column.ndim == 2 else known)] = np.nan
    return rows


def to_messages(rows: Rows) -> Iterator[dict[str, Any]]:
    """Yield the content of the message of each row, without unknown numbers."""
    names = rows.dtype.names or ()
    for row in zip(*(plain(rows[name]) for name in names), strict=True):
        yield {name: value for name, value in zip(names, row, strict=True) if value is not None}


def plain(column: Rows) -> list[Any]:
    """Return the values of a column: decoded text, and None for NaN."""
    if column.dtype.kind == "S":
        return [text.decode("utf-8", "replace") for text in column.tolist()]
    first = column[:, 0] if column.ndim == 2 else column
    unknown = (first != first).tolist()
    return [None if no else value for value, no in zip(column.tolist(), unknown, strict=True)]


def from_messages(messages: Sequence[Mapping[str, Any]], kind: np.dtype[Any]) -> Rows:
    """Return rows from the contents of their messages.

    Raises:
        KeyError: A whole number, a text or the time is missing.
        TypeError: A field holds another kind of value.
        ValueError: A field holds another shape, or a number beyond `MAX_NUMBER`.
    """
    made = np.zeros(len(messages), kind)
    for name in kind.names or () if messages else ():
        base = kind[name].base.kind
        if base == "S":
            made[name] = [str(message[name]).encode() for message in messages]
            continue
        unknown = np.full(kind[name].shape, np.nan)
        needed = base == "i" or name == "time"
        given = np.array([m[name] if needed else m.get(name, unknown) for m in messages])
        if given.dtype.kind not in ("fi" if base == "f" else "i"):
            raise TypeError(f"{name} holds {given.dtype} values")
        if np.any(np.abs(given) > MAX_NUMBER):
            raise ValueError(f"{name} holds numbers beyond {MAX_NUMBER:g}")
        made[name] = given
    return made
