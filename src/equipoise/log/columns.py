"""Tables of a run log: name, unit, meaning and type of each column.

A table is a structured array with one row per message of the topic with its name::

    tick     100 Hz          the policy's observation and command, and the timing of the loop
    truth    100 Hz          the real state; in simulation only
    stream   200 Hz          setpoints as sent
    reply    200 Hz          joint positions or torques as measured
    encoder  up to 1 kHz     counts, and faults of board and link
    event    rarely          changes of the phase, prompts and faults, as text

Times are those of the run's clock [s]: on a rig its monotonic clock, in simulation the time since
the release. NaN represents an unknown number; the message omits its field.

Rings, messages, JSON schemas, files and CSV tables follow from `TABLES`. The value of a field comes
from `equipoise.log.recorder` on a rig, from `equipoise.rig.simulate` in simulation.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[Any]
"""Rows of a table, as a structured array."""
MAX_NUMBER: Final = 1e12
"""Limit on times [s], counts and all other numbers in a row: a board's counts begin anywhere in 32
bits and go on beyond them; products of numbers within it stay finite."""


class Column(NamedTuple):
    """A column of a table."""

    name: str
    """Name of the field in messages."""
    unit: str
    """Unit; empty without one."""
    description: str
    """Meaning, with sign or reference."""
    kind: str = "<f8"
    """Type of number or text, as NumPy names it, or `joints`: a number per joint."""


TABLES: Final[Mapping[str, tuple[Column, ...]]] = {
    "tick": (
        Column("time", "s", "Start of the tick"),
        Column("late", "s", "Delay behind the deadline; on a rig"),
        Column("compute", "s", "Computing time, reading to sending; on a rig"),
        Column("state", "", "Phase, as index in `phases` of the conditions", "<i8"),
        Column("x", "m", "Displacement of the flange from home, as observed"),
        Column("x_dot", "m/s", "Velocity of the flange, as observed"),
        Column("phi", "rad", "Angle from upright, towards +x, as observed"),
        Column("phi_dot", "rad/s", "Angular velocity, as observed"),
        Column("box", "", "Box of the table; -1 outside the balance", kind="<i8"),
        Column("u", "m/s^2", "Commanded acceleration of the flange along x"),
        Column("estimated_phi", "rad", "Estimate of phi at the tick, not predicted"),
        Column("estimated_phi_dot", "rad/s", "Estimate of phi_dot at the tick"),
        Column("bias", "rad", "Estimate of the encoder's zero error"),
        Column("estimated_x_dot", "m/s", "Estimate of x_dot at the tick"),
        Column("estimated_x", "m", "Estimate of x at the tick"),
        Column("q", "rad", "Joints commanded for the end of the tick", "joints"),
        Column("dq", "rad/s", "Velocities commanded for that time", "joints"),
    ),
    "truth": (
        Column("time", "s", "Start of the tick"),
        Column("x", "m", "Displacement of the flange from home along base x"),
        Column("x_dot", "m/s", "Velocity of the flange"),
        Column("phi", "rad", "Angle of the pendulum from upright, towards +x"),
        Column("phi_dot", "rad/s", "Angular velocity of the pendulum"),
        Column("tracked", "m/s^2", "Acceleration of the flange over the tick"),
        Column("q", "rad", "Joint positions", kind="joints"),
    ),
    "stream": (
        Column("time", "s", "Time of sending"),
        Column("q", "rad", "Setpoints of the joints", kind="joints"),
    ),
    "reply": (
        Column("time", "s", "Time of arrival"),
        Column("sent", "s", "Time of the request; unknown of the posture at the start"),
        Column("q", "rad", "Measured joint positions", kind="joints"),
        Column("torque", "N m", "Measured external torques", kind="joints"),
        Column("taken", "s", "Tick that took the reply; on a rig"),
    ),
    "encoder": (
        Column("time", "s", "Time stamp of the sample"),
        Column("counts", "", "Counts; in simulation from the zero", kind="<i8"),
        Column("pressed", "", "1 while the button is pressed", kind="<i8"),
        Column("illegal", "", "1 where the board saw an illegal transition", kind="<i8"),
        Column("missing", "", "Number of lines lost before this one", kind="<i8"),
        Column("received", "s", "Tick that took the sample; on a rig"),
    ),
    "event": (
        Column("time", "s", "Time"),
        Column("name", "", "Phase that began, or kind of message", kind="S32"),
        Column("answers", "", "Words expected from the operator, separated by |", kind="S96"),
        Column("text", "", "Sentence for the operator", kind="S400"),
    ),
}
"""Columns of each table."""


def tables(joints: int) -> dict[str, np.dtype[Any]]:
    """Return the type of the rows of each table, for an arm with `joints` joints."""
    posture = f"({joints},)<f8"
    return {
        name: np.dtype([(c.name, posture if c.kind == "joints" else c.kind) for c in columns])
        for name, columns in TABLES.items()
    }


def unknown_rows(kind: np.dtype[Any], count: int) -> Rows:
    """Return rows of a type without content: NaN, zero and empty texts, shape (count,)."""
    rows = np.zeros(count, kind)
    for name in kind.names or ():
        if kind[name].base.kind == "f":
            rows[name] = np.nan
    return rows


def schema(table: str) -> dict[str, Any]:
    """Return the JSON schema of the messages of a table; Foxglove needs one to plot."""
    kinds: dict[str, dict[str, Any]] = {
        "<f8": {"type": "number"},
        "<i8": {"type": "integer"},
        "joints": {"type": "array", "items": {"type": "number"}},
    }
    properties = {
        c.name: kinds.get(c.kind, {"type": "string"})
        | {"description": f"{c.description} [{c.unit}]" if c.unit else c.description}
        for c in TABLES.get(table, ())
    }
    return {"type": "object", "properties": properties}


def to_messages(rows: Rows) -> Iterator[dict[str, Any]]:
    """Yield the content of the message of each row, without unknown numbers."""
    names = rows.dtype.names or ()
    for row in zip(*(plain(rows[name]) for name in names), strict=True):
        yield {name: value for name, value in zip(names, row, strict=True) if value is not None}


def plain(column: Rows) -> list[Any]:
    """Return the values of a column: decoded text, and None for unknown numbers.

    Numbers beyond `MAX_NUMBER` and incomplete postures count as unknown.
    """
    if column.dtype.kind == "S":
        return [text.decode("utf-8", "ignore") for text in column.tolist()]
    known: Any = np.abs(column) <= MAX_NUMBER
    known = known.all(axis=1) if column.ndim == 2 else known
    values = zip(column.tolist(), known.tolist(), strict=True)
    return [value if sound else None for value, sound in values]


def to_csv(table: str, rows: Rows, joints: Sequence[str]) -> dict[str, list[Any]]:
    """Return the columns of a CSV file, one for each of the joints, by their names with units."""
    columns: dict[str, list[Any]] = {}
    for name, unit, _, kind in TABLES[table]:
        end = "_" + unit.replace("/", "_").replace("^", "").replace(" ", "") if unit else ""
        if kind == "joints":
            for joint, values in zip(joints, rows[name].T, strict=True):
                columns[f"{name}_{joint}{end}"] = plain(values)
        else:
            columns[f"{name}{end}"] = plain(rows[name])
    return columns


def from_messages(messages: Sequence[Mapping[str, Any]], kind: np.dtype[Any]) -> Rows:
    """Return rows from the contents of their messages.

    Raises:
        KeyError: A whole number, a text or the time is missing.
        TypeError: A field holds another kind of value.
        ValueError: A field holds another shape, or a number beyond `MAX_NUMBER`.
    """
    made = unknown_rows(kind, len(messages))
    for name in kind.names or () if messages else ():
        base = kind[name].base.kind
        if base == "S":
            made[name] = [str(message[name]).encode() for message in messages]
            continue
        needed = base == "i" or name == "time"
        unknown = made[name][0]
        values = np.array([m[name] if needed else m.get(name, unknown) for m in messages])
        if values.dtype.kind not in ("fi" if base == "f" else "i"):
            raise TypeError(f"{name} holds {values.dtype} values")
        if np.any(np.abs(values) > MAX_NUMBER):
            raise ValueError(f"{name} holds numbers beyond {MAX_NUMBER:g}")
        made[name] = values
    return made
