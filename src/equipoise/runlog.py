"""What one run went through, and the MCAP file that carries it.

A tick is one decision of the policy: the state that it saw, the box of that state, the acceleration
that it commanded, and what was commanded to the arm until the next tick. Beside the ticks stand
what was sent to a rig and measured on it, and the truth, which only a simulation knows. The file
has a topic for each, which Foxglove opens and plots, in the order of time::

    /run      once, first      the conditions of the run
    /tick     once per tick    the row, by the names of `RunLog`
    /truth    once per tick    the real state, by the names of `Truth`; not on a robot
    /stream   per setpoint     by the names of `Stream`; on a rig, as the next two
    /reply    per reply        by the names of `Replies`
    /encoder  per sample       by the names of `EncoderSamples`
    /end      once, last       how long the run lasted and how it ended

Time counts from the release. Log time, which cannot be negative, counts from the first row where
that is earlier. Messages are JSON, compressed with zstd. The digest covers conditions and rows, so
that a file that was cut, damaged or edited is refused with one sentence, or read to the last tick
before the damage. It is written whole or not at all. Files of version 1, which hold ticks alone,
are read.
"""

import hashlib
import heapq
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from equipoise.artefacts import (
    DIGEST_PREFIX,
    Name,
    Number,
    Provenance,
    StrPath,
    Value,
    write_whole,
)
from equipoise.errors import ArtefactError
from equipoise.mcapfile import (
    CHUNK,
    LARGEST_NUMBER,
    MOST_JOINTS,
    McapContent,
    read_mcap,
    sealed,
)
from equipoise.settings import Settings
from equipoise.views import Viewable

FORMAT: Final = "equipoise-run"
VERSION: Final = 2
IDEAL: Final = "ideal"
"""In place of the digest of an actuator: the arm follows its commands at once."""

PendulumName: TypeAlias = Literal["w2", "k", "c", "coulomb", "drag"]

Array: TypeAlias = npt.NDArray[np.float64]
Whole: TypeAlias = npt.NDArray[np.int64]


class RunConditions(Value):
    """Where a run took place, and what decided about it."""

    policy: Name
    """Digest of the policy that ran; empty where the arm was only excited."""
    world: Name
    """What stood in for the robot and the pendulum."""
    arm: Name
    """Name of the arm."""
    joints: tuple[Name, ...] = Field(min_length=1, max_length=MOST_JOINTS)
    """Names of its joints, from the base to the flange."""
    held_joint: int | None = Field(ge=1, le=MOST_JOINTS)
    """The joint that does not move, counted from one."""
    pendulum: dict[PendulumName, Number] = Field(min_length=5)
    """Numbers of the pendulum that really swung: w2 [1/s^2], k [1/m], c [1/s], coulomb [1/s^2],
    drag [1/rad]."""
    friction: dict[str, float | str] | None = None
    """Dry friction and drag of the pendulum on a twin, and who set them, by the names of
    `PivotFriction`; none elsewhere."""
    start: tuple[Number, Number, Number, Number]
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release."""
    h: float = Field(ge=1e-4, le=1.0)
    """Time between ticks [s]."""
    duration: float = Field(ge=0.0, le=1e6)
    """How long the run was to last [s]."""
    seed: int
    """Master seed of pendulum, start and noise."""
    actuator: Name
    """Digest of the actuator that the controller believed in, or `ideal`."""
    counts_per_rev: int | None = Field(ge=1, le=2**24)
    """Encoder counts per revolution; none where the angle is known without an encoder."""
    world_settings: dict[str, float | int | str | None] | None
    """Resolved numbers of the digital twin; none elsewhere."""
    zero_error: Number | None
    """Error of the encoder's zero [rad]; none where there is no encoder, or nobody knows."""
    settings: Settings
    """Resolved settings: gains, noise, ranges of the start."""
    cause: Name
    """How the run ended: lasted, angle, track, joint limit, guard."""
    guard: Name = ""
    """Which guard ended it; empty where none did."""

    @property
    def free(self) -> tuple[int, ...]:
        """Places of the joints that move, counted from zero."""
        return tuple(i for i in range(len(self.joints)) if i + 1 != self.held_joint)


class TruthColumns(NamedTuple):
    """What only a simulation knows, once per tick; no rows on a robot."""

    x: Array
    """Displacement of the flange from home along base x at the tick [m], shape (n,)."""
    x_dot: Array
    """Its velocity [m/s], shape (n,)."""
    phi: Array
    """Angle of the pendulum from upright [rad], shape (n,)."""
    phi_dot: Array
    """Its angular velocity [rad/s], shape (n,)."""
    q: Array
    """Positions of all joints at the tick [rad], shape (n, joints)."""


class Stream(NamedTuple):
    """Setpoints as they were sent; no rows on the ideal model."""

    time: Array
    """When each was sent, since the release [s], shape (m,)."""
    q: Array
    """All joints [rad], shape (m, joints)."""


class Replies(NamedTuple):
    """Joint positions as they were measured; no rows on the ideal model."""

    time: Array
    """When each was measured, since the release [s], shape (p,)."""
    q: Array
    """All joints [rad], shape (p, joints)."""


class EncoderSamples(NamedTuple):
    """Counts of the pendulum's encoder; no rows on the ideal model."""

    time: Array
    """Time stamp of each, since the release [s], shape (r,)."""
    counts: Whole
    """Counts from where the encoder was zeroed, shape (r,)."""


Part = TypeVar("Part", TruthColumns, Stream, Replies, EncoderSamples)


def _no_rows(kind: type[Part]) -> Part:
    return kind._make(() for _ in kind._fields)


@dataclass(frozen=True, eq=False, repr=False)
class RunLog(Viewable):
    """One run; its arrays cannot be written to."""

    conditions: RunConditions
    """Where it took place, and how it ended."""
    time: Array
    """Start of each tick since the release [s], shape (n,)."""
    x: Array
    """Displacement of the flange from home along base x, as the policy saw it [m], shape (n,). On a
    rig it saw this and the next three as predicted to when its command takes effect."""
    x_dot: Array
    """Its velocity [m/s], shape (n,)."""
    phi: Array
    """Angle of the pendulum from upright [rad], shape (n,)."""
    phi_dot: Array
    """Its angular velocity [rad/s], shape (n,)."""
    box: Whole
    """Box of the table that held the state, shape (n,)."""
    u: Array
    """Commanded acceleration of the flange along x [m/s^2], shape (n,)."""
    tracked: Array
    """Acceleration u' of the flange over the tick [m/s^2], shape (n,)."""
    q: Array
    """All joints as commanded for the end of the tick [rad], shape (n, joints)."""
    dq: Array
    """Their velocities [rad/s], shape (n, joints)."""
    estimated_phi: Array
    """Estimate of phi at the tick, before any prediction [rad], shape (n,)."""
    estimated_phi_dot: Array
    """Estimate of phi_dot at the tick [rad/s], shape (n,)."""
    bias: Array
    """Estimate of the error of the encoder's zero [rad], shape (n,)."""
    truth: TruthColumns = field(default_factory=partial(_no_rows, TruthColumns))
    """What really was, where a simulation tells."""
    stream: Stream = field(default_factory=partial(_no_rows, Stream))
    """What was sent to the arm."""
    replies: Replies = field(default_factory=partial(_no_rows, Replies))
    """What the arm measured."""
    encoder: EncoderSamples = field(default_factory=partial(_no_rows, EncoderSamples))
    """What the pendulum's encoder measured."""
    damage: str = ""
    """Where the file is damaged that these are the first ticks of, as a clause; empty where the run
    is whole."""

    def __post_init__(self) -> None:
        """Check the shapes, and freeze the arrays.

        Raises:
            ArtefactError: Shapes that differ, or values that are no finite numbers.
        """
        ticks, joints = len(self.time), len(self.conditions.joints)
        for name in COLUMNS:
            column = _column(name, getattr(self, name), ticks, joints)
            object.__setattr__(self, name, column)
        for name, kind in PARTS.items():
            part = getattr(self, name)
            rows = ticks if kind is TruthColumns and len(part[0]) else len(part[0])
            columns = zip(kind._fields, part, strict=True)
            checked = kind._make(_column(f"{name}.{of}", v, rows, joints) for of, v in columns)
            object.__setattr__(self, name, checked)

    @classmethod
    def of_excitation(cls, conditions: RunConditions, stream: Stream, replies: Replies) -> Self:
        """Return a run without ticks: the arm was moved, no policy decided.

        Raises:
            ArtefactError: Shapes that differ, or values that are no finite numbers.
        """
        nothing: dict[str, Any] = dict.fromkeys(COLUMNS, ())
        return cls(conditions=conditions, stream=stream, replies=replies, **nothing)

    def __repr__(self) -> str:
        """Return one line: where it ran, how long, and how it ended."""
        told = self.conditions
        return (
            f"<RunLog of {told.arm!r} in {told.world!r}: lasted {self.lasted:g} of "
            f"{told.duration:g} s, ended {told.cause!r}>"
        )

    @property
    def lasted(self) -> float:
        """How long the run lasted [s]; without ticks, until the last setpoint was sent."""
        if len(self.time):
            return round(len(self.time) * self.conditions.h, 9)
        return float(np.max(self.stream.time, initial=0.0))

    @property
    def digest(self) -> str:
        """SHA-256 of conditions and rows."""
        return self._digest(_json(self.conditions.model_dump(mode="json")), VERSION)

    def _digest(self, conditions: bytes, version: int) -> str:
        digest = hashlib.sha256(conditions)
        for paths in LAYOUTS[version].values():
            for path in paths:
                values = attrgetter(path)(self)
                little = values.astype(values.dtype.newbyteorder("<"))
                digest.update(path.encode() + little.tobytes())
        return DIGEST_PREFIX + digest.hexdigest()

    def save(self, path: StrPath, *, command: str, inputs: Mapping[str, str] | None = None) -> None:
        """Write the run to `path`, whole or not at all.

        Args:
            path: The file; its folder is made if it is missing.
            command: The verb or function that made the run.
            inputs: Digests of the values it was made from, by name.

        Raises:
            OutsideError: The disk refuses.
        """
        from mcap.writer import CompressionType, Writer

        provenance = Provenance.now(command, inputs)
        stream = io.BytesIO()
        writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        writer.start(profile="", library=FORMAT)
        writer.add_metadata(
            FORMAT,
            sealed(
                {
                    "version": str(VERSION),
                    "digest": self.digest,
                    "provenance": provenance.model_dump_json(),
                }
            ),
        )
        channels: dict[str, int] = {}
        for topic, schema in _schemas(len(self.conditions.joints)).items():
            text = json.dumps(schema).encode()
            number = writer.register_schema(f"equipoise{topic}", "jsonschema", text)
            channels[topic] = writer.register_channel(topic, "json", number)
        for sequence, (stamp, topic, message) in enumerate(self._messages()):
            writer.add_message(channels[topic], stamp, _json(message), stamp, sequence)
        writer.finish()
        write_whole(Path(path), stream.getvalue())

    def _messages(self) -> Iterator[tuple[int, str, dict[str, Any]]]:
        """Yield log time [ns], topic and content of each message, in the order of time."""
        parts = (self.time, self.stream.time, self.replies.time, self.encoder.time)
        times = np.concatenate((*parts, (0.0, self.lasted)))
        first, last = float(times.min()), float(times.max())
        end = {"lasted": self.lasted, "cause": self.conditions.cause}
        yield 0, "/run", self.conditions.model_dump(mode="json")
        # Rows of one topic keep their order even where their times do not increase.
        rows = heapq.merge(*map(self._rows, LAYOUTS[VERSION]), key=itemgetter(0))
        for time, topic, row in rows:
            yield round((time - first) * 1e9), topic, row
        yield round((last - first) * 1e9), "/end", end

    def _rows(self, topic: str) -> Iterator[tuple[float, str, dict[str, Any]]]:
        paths = LAYOUTS[VERSION][topic]
        names = [_name(path) for path in paths]
        columns = [attrgetter(path)(self).tolist() for path in paths]
        times = columns[0] if names[0] == "time" else self.time.tolist()
        for time, *row in zip(times, *columns, strict=False):  # truth may have no rows
            yield time, topic, dict(zip(names, row, strict=True))

    @classmethod
    def load(cls, path: StrPath, *, damaged: bool = False) -> Self:
        """Read a run from `path`.

        Args:
            path: The file.
            damaged: Take the ticks before the first damage, and say so in `damage`; without, a
                damaged file is refused.

        Raises:
            ArtefactError: The file is missing, corrupt, edited, not ours or newer; or of a damaged
                one nothing can be used.
        """
        path = Path(path)
        version, metadata, content = _read(path)
        messages, damage = content.messages, content.damage
        columns: dict[str, Any] = {}
        try:
            written = messages["/run"][0]
            conditions = json.loads(written)
            for topic, paths in LAYOUTS[version].items():
                rows = [json.loads(message) for message in messages.get(topic, ())]
                columns |= {path: [row[_name(path)] for row in rows] for path in paths}
            if version == 1:
                _upgrade(conditions, columns)
            if not messages.get("/end"):
                damage = damage or "has no end"
                _keep_whole_ticks(conditions, columns, content.last)
            given: dict[str, Any] = {name: columns[name] for name in COLUMNS}
            for name, kind in PARTS.items():
                given[name] = kind._make(columns.get(f"{name}.{of}", ()) for of in kind._fields)
            text = _json(conditions)
            run = cls(conditions=RunConditions.model_validate_json(text, strict=True), **given)
        except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
            first = error.errors()[0] if isinstance(error, ValidationError) else None
            if first is not None and first["type"] == "extra_forbidden":
                field = ".".join(map(str, first["loc"]))
                raise ArtefactError(
                    f"{path} is not a valid {FORMAT!r} file: this Equipoise does not know the "
                    f"field {field}; upgrade it, or record the run again"
                ) from None
            raise ArtefactError(
                f"{path} {damage or 'is not a valid run log: its messages are incomplete'}"
                f"{', before the first tick' if damage else ''}; record the run again"
            ) from None
        if run._digest(written, version) == metadata.get("digest"):
            return run
        if not damage:
            raise ArtefactError(
                f"{path} does not match its digest: it was edited or damaged after it was "
                "written; record the run again"
            )
        if not damaged:
            raise ArtefactError(
                f"{path} {damage}: the first {len(run.time):,} ticks, {run.lasted:g} s, are sound; "
                "explain, replay and export read them, or record the run again"
            )
        return replace(run, damage=damage)


PARTS: Final = {
    "truth": TruthColumns,
    "stream": Stream,
    "replies": Replies,
    "encoder": EncoderSamples,
}
"""What a run log holds beside its ticks."""

OTHERS: Final = ("conditions", "damage", *PARTS)
"""Names of the fields of `RunLog` that are no column of a tick."""

COLUMNS: Final = tuple(one.name for one in fields(RunLog) if one.name not in OTHERS)
"""Names of the arrays of a tick, in their order."""

LAYOUTS: Final[Mapping[int, Mapping[str, tuple[str, ...]]]] = {
    1: {"/tick": ("time", "x", "x_dot", "phi", "phi_dot", "box", "u", "tracked", "q", "dq")},
    2: {
        "/tick": COLUMNS,
        "/truth": tuple(f"truth.{name}" for name in TruthColumns._fields),
        "/stream": tuple(f"stream.{name}" for name in Stream._fields),
        "/reply": tuple(f"replies.{name}" for name in Replies._fields),
        "/encoder": tuple(f"encoder.{name}" for name in EncoderSamples._fields),
    },
}
"""For each version the topics with rows, and the attributes of `RunLog` that are their columns."""

PER_JOINT: Final = ("q", "dq")
"""Columns with one number per joint; others have one number."""
WHOLE: Final = ("box", "counts")
"""Columns of whole numbers."""


def _name(path: str) -> str:
    """Return what messages call the column `path`."""
    return path.rpartition(".")[2]


def _column(path: str, given: Any, rows: int, joints: int) -> npt.NDArray[Any]:
    """Return a frozen copy of a column, if it has the shape and the values that it should have."""
    shape = (rows, joints) if _name(path) in PER_JOINT else (rows,)
    values: npt.NDArray[Any] = np.array(given, dtype=np.float64)
    if rows == values.size == 0:
        values = values.reshape(shape)
    if values.shape != shape:
        raise ArtefactError(
            f"{path} of a run log has shape {values.shape}, expected {shape}: give all columns "
            f"of a table as many rows, and {', '.join(PER_JOINT)} one number per joint"
        )
    if not np.all(np.abs(values) <= LARGEST_NUMBER):
        raise ArtefactError(
            f"{path} of a run log holds values that are not finite, or beyond "
            f"{LARGEST_NUMBER:g}; record the run again"
        )
    if _name(path) in WHOLE:
        whole = np.array(given, dtype=np.int64).reshape(shape)
        if np.any(whole != values):
            raise ArtefactError(
                f"{path} of a run log holds values that are not whole numbers; round them"
            )
        values = whole
    values.flags.writeable = False
    return values


def _upgrade(conditions: dict[str, Any], columns: dict[str, Any]) -> None:
    """Add what version 1 did not say: it knew the ideal model alone, which needs no estimate."""
    conditions |= {
        "actuator": IDEAL,
        "counts_per_rev": None,
        "world_settings": None,
        "zero_error": None,
    }
    columns |= {
        "estimated_phi": columns["phi"],
        "estimated_phi_dot": columns["phi_dot"],
        "bias": [0.0] * len(columns["phi"]),
    }


def _keep_whole_ticks(conditions: Mapping[str, Any], columns: dict[str, Any], last: float) -> None:
    """Drop the ticks of which another table may lack rows, where a file ends at log time `last`.

    Messages stand in the order of time: with a message one period after a tick, all rows that
    belong to the tick are there.
    """
    h, times = float(conditions["h"]), columns["time"]
    # Log time counts from the earliest row, which is in the first chunk.
    parts = ("stream.time", "replies.time", "encoder.time", "time")
    first = min([0.0, *(min(columns[name]) for name in parts if columns.get(name))])
    whole = sum(time + h <= last + first + 1e-9 for time in times)
    for name in (*COLUMNS, *(f"truth.{name}" for name in TruthColumns._fields)):
        columns[name] = columns.get(name, ())[:whole]


class Header(NamedTuple):
    """What a file says about itself."""

    version: int
    """Version of the format that it has."""
    digest: str
    """SHA-256 of conditions and rows, as that version has them."""
    provenance: Provenance
    """Where it comes from."""


def read_header(path: Path) -> Header:
    """Return what the file `path` says about itself.

    Raises:
        ArtefactError: The file is missing, corrupt, not ours or newer.
    """
    version, metadata, _ = _read(path, messages=False)
    try:
        provenance = Provenance.model_validate_json(metadata["provenance"])
        return Header(version, metadata["digest"], provenance)
    except (KeyError, ValidationError):
        raise ArtefactError(
            f"{path} does not say where it comes from; record the run again"
        ) from None


def _read(path: Path, *, messages: bool = True) -> tuple[int, Mapping[str, str], McapContent]:
    """Return version, our metadata, and what is sound of the file."""
    content = read_mcap(path, messages=messages)
    metadata = content.metadata.get(FORMAT, {})
    version = metadata.get("version", "")
    if not metadata and content.damage:
        raise ArtefactError(f"{path} {content.damage}, in its header; record the run again")
    if not (version.isascii() and version.isdecimal() and len(version) < 9 and int(version)):
        raise ArtefactError(f"{path} is no run log of Equipoise; give a file that it wrote")
    if int(version) > VERSION:
        raise ArtefactError(
            f"{path} has version {version} of {FORMAT!r}, this Equipoise reads up to {VERSION}; "
            "upgrade Equipoise"
        )
    return int(version), metadata, content


def _schemas(joints: int) -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each topic; Foxglove needs one to plot."""
    number, whole, word = ({"type": kind} for kind in ("number", "integer", "string"))
    per_joint = {"type": "array", "items": number, "minItems": joints}
    kinds: dict[str, Any] = dict.fromkeys(WHOLE, whole)
    kinds |= dict.fromkeys(PER_JOINT, per_joint)
    tables = {
        topic: {_name(path): kinds.get(_name(path), number) for path in paths}
        for topic, paths in LAYOUTS[VERSION].items()
    }
    tables["/end"] = {"lasted": number, "cause": word}
    schemas = {t: {"type": "object", "properties": columns} for t, columns in tables.items()}
    return {"/run": RunConditions.model_json_schema(), **schemas}


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
