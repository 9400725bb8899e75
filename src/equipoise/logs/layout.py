"""Tables of a run log: columns, units, and the JSON schemas of their topics.

A table is a structured array with one row per message of the topic with its name::

    tick     100 Hz          the policy's observation and command, and the timing of the loop
    truth    100 Hz          the real state; in simulation only
    stream   200 Hz          setpoints as sent
    reply    200 Hz          joint positions or torques as measured
    encoder  up to 1 kHz     counts, and faults of board and link
    event    rarely          changes of the phase, prompts and faults, as text

Times are those of the run's clock [s]: on a rig its monotonic clock, in simulation the time since
the release. NaN represents an unknown number; the message omits its field.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.logs.container import MAX_NUMBER

Rows = npt.NDArray[Any]
"""Rows of a table, as a structured array."""


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


TIME: Final = Column("time", "number", "s", "Time")
TABLES: Final[Mapping[str, tuple[Column, ...]]] = {
    "tick": (
        TIME._replace(description="Start of the tick"),
        Column("late", "number", "s", "Delay of the start behind its deadline; on a rig"),
        Column("compute", "number", "s", "Computing time, from reading to sending; on a rig"),
        Column("state", "whole", "", "Phase, by its index in `phases` of the conditions"),
        Column(
            "x", "number", "m", "Displacement of the flange from home, as observed by the policy"
        ),
        Column("x_dot", "number", "m/s", "Velocity of the flange, as observed by the policy"),
        Column("phi", "number", "rad", "Angle from upright, towards +x, as observed by the policy"),
        Column("phi_dot", "number", "rad/s", "Angular velocity, as observed by the policy"),
        Column("box", "whole", "", "Box of the table that holds the state"),
        Column("u", "number", "m/s^2", "Commanded acceleration of the flange along x"),
        Column("estimated_phi", "number", "rad", "Estimate of phi at the tick, not predicted"),
        Column("estimated_phi_dot", "number", "rad/s", "Estimate of phi_dot at the tick"),
        Column("bias", "number", "rad", "Estimate of the encoder's zero error"),
        Column("q", "joints", "rad", "Joint positions commanded for the end of the tick"),
        Column("dq", "joints", "rad/s", "Joint velocities commanded for the end of the tick"),
    ),
    "truth": (
        TIME._replace(description="Start of the tick"),
        Column("x", "number", "m", "Displacement of the flange from home along base x"),
        Column("x_dot", "number", "m/s", "Velocity of the flange"),
        Column("phi", "number", "rad", "Angle of the pendulum from upright, towards +x"),
        Column("phi_dot", "number", "rad/s", "Angular velocity of the pendulum"),
        Column("tracked", "number", "m/s^2", "Acceleration of the flange over the tick"),
        Column("q", "joints", "rad", "Joint positions"),
    ),
    "stream": (
        TIME._replace(description="Time of sending"),
        Column("q", "joints", "rad", "Setpoints of the joints"),
    ),
    "reply": (
        TIME._replace(description="Time of arrival"),
        Column("sent", "number", "s", "Time of the request; unknown of the posture at the start"),
        Column("q", "joints", "rad", "Measured joint positions"),
        Column("torque", "joints", "N m", "Measured external torques"),
        Column("taken", "number", "s", "Tick that took the reply; on a rig"),
    ),
    "encoder": (
        TIME._replace(description="Time stamp of the sample"),
        Column("counts", "whole", "", "Counts; in simulation from the zero"),
        Column("pressed", "whole", "", "1 while the button is pressed"),
        Column("illegal", "whole", "", "1 where the board saw an illegal transition"),
        Column("missing", "whole", "", "Number of lines lost before this one"),
        Column("received", "number", "s", "Tick that took the sample; on a rig"),
    ),
    "event": (
        TIME,
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
    """Return rows with NaN in place of infinities and of incomplete postures."""
    rows = rows.copy()
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.dtype.kind == "f":
            known = np.isfinite(column)
            column[~(known.all(axis=1) if column.ndim == 2 else known)] = np.nan
    return rows


def to_messages(rows: Rows) -> Iterator[dict[str, Any]]:
    """Yield the content of the message of each row, without unknown numbers."""
    names = rows.dtype.names or ()
    for row in zip(*(_plain(rows[name]) for name in names), strict=True):
        yield {name: value for name, value in zip(names, row, strict=True) if value is not None}


def _plain(column: Rows) -> list[Any]:
    if column.dtype.kind == "S":
        return [text.decode("utf-8", "replace") for text in column.tolist()]
    if column.dtype.kind == "i" or bool(np.isfinite(column).all()):
        return column.tolist()
    first = column[:, 0] if column.ndim == 2 else column
    return [
        None if unknown else value
        for value, unknown in zip(column.tolist(), np.isnan(first).tolist(), strict=True)
    ]


def from_messages(messages: list[Any], kind: np.dtype[Any]) -> Rows:
    """Return rows from the contents of their messages.

    Raises:
        KeyError: A whole number or a text is missing.
        TypeError: A field holds another kind of value.
        ValueError: A field holds an invalid value, a number beyond `MAX_NUMBER`, or no time.
    """
    made = np.zeros(len(messages), kind)
    for name in kind.names or () if messages else ():
        base = kind[name].base.kind
        if base == "S":
            made[name] = [str(message[name]).encode() for message in messages]
            continue
        unknown = np.full(kind[name].shape, np.nan)
        given = np.array(
            [message.get(name, unknown) if base == "f" else message[name] for message in messages]
        )
        if given.dtype.kind not in ("fi" if base == "f" else "i"):
            raise TypeError(name)
        if np.any(np.abs(given) > MAX_NUMBER) or (name == "time" and np.isnan(given).any()):
            raise ValueError(name)
        made[name] = given
    return made
