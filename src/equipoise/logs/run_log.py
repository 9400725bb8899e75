"""Log of a run: the tables of the whole run, and the columns of the balancing.

`tables`, `events` and `end` hold the whole run: on a rig from the connection to rest, in simulation
from the release on. The other attributes hold the balancing, during which the policy acts: a value
per tick, with the time since the release. On a rig the encoder's counts are then relative to the
hanging pendulum, and the true state is unknown.

A truncated or damaged log is read up to the first damage, on request. A log whose rows contradict
the digest at its end was edited, and is rejected.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from equipoise.artefacts import Provenance, StrPath, check_version, write_whole
from equipoise.errors import ArtefactError, RecordingError
from equipoise.logs.conditions import RunConditions, RunEnd
from equipoise.logs.container import MAX_NUMBER, read_mcap
from equipoise.logs.layout import TABLES, Rows, canonical, from_messages, tables
from equipoise.logs.recorder import LoggedEvent, read_events
from equipoise.logs.writer import FORMAT, VERSION, Digest, LogEncoder
from equipoise.outcomes import Outcome, Phase
from equipoise.views import Viewable

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FAULTS: Final = (
    AttributeError,
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    RecursionError,
)
"""Exceptions from parsing the values of a damaged or foreign log."""


class TruthColumns(NamedTuple):
    """True state at each tick; no rows on a rig."""

    x: Array
    """Displacement of the flange from home along base x [m], shape (n,)."""
    x_dot: Array
    """Velocity of the flange [m/s], shape (n,)."""
    phi: Array
    """Angle of the pendulum from upright [rad], shape (n,)."""
    phi_dot: Array
    """Angular velocity of the pendulum [rad/s], shape (n,)."""
    tracked: Array
    """Acceleration of the flange over the tick [m/s^2], shape (n,)."""
    q: Array
    """Joint positions [rad], shape (n, joints)."""


class JointSamples(NamedTuple):
    """Joint positions as sent or as measured; no rows on the ideal model."""

    time: Array
    """Time since the release [s], shape (m,)."""
    q: Array
    """Joint positions [rad], shape (m, joints)."""


class EncoderSamples(NamedTuple):
    """Counts of the pendulum's encoder; no rows on the ideal model."""

    time: Array
    """Time stamp since the release [s], shape (r,)."""
    counts: IntArray
    """Counts relative to the zero, shape (r,)."""


class _TickColumn:
    """Column of the ticks of the balancing, as an attribute of a run with the column's name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, run: "RunLog", owner: type) -> npt.NDArray[Any]:
        return run.ticks[self._name]


@dataclass(frozen=True, eq=False, repr=False)
class RunLog(Viewable):
    """One run; its arrays are read-only."""

    conditions: RunConditions
    """Place and settings of the run."""
    tables: Mapping[str, Rows]
    """Rows of each table of `equipoise.logs.layout`, as structured arrays."""
    end: RunEnd | None
    """End of the run; None for a log without one."""
    damage: str = ""
    """Place and kind of the damage, as a clause; empty for a complete log."""
    provenance: Provenance | None = field(default=None)
    """Provenance of the file; None for a run that was not loaded."""

    @classmethod
    def simulated(
        cls,
        conditions: RunConditions,
        end: RunEnd,
        ticks: Mapping[str, Any],
        *,
        truth: Mapping[str, Any] | None = None,
        stream: Mapping[str, Any] | None = None,
        replies: Mapping[str, Any] | None = None,
        encoder: Mapping[str, Any] | None = None,
    ) -> Self:
        """Create a simulated run from columns, with the names of `equipoise.logs.layout`.

        Args:
            conditions: Conditions of the run.
            end: End of the run.
            ticks: Columns of the ticks; empty if no policy ran.
            truth: Columns of the true state, without the time; None if not recorded.
            stream: Columns `time` and `q` of the setpoints.
            replies: Columns `time` and `q` of the measured joints.
            encoder: Columns `time` and `counts` of the samples.

        Raises:
            ArtefactError: Columns differ in length, or values are not finite.
        """
        given: dict[str, Mapping[str, Any]] = {
            "tick": {"late": 0.0, "compute": 0.0, **ticks},
            "truth": {"time": ticks.get("time", ()), **truth} if truth else {},
            "stream": stream or {},
            "reply": {**replies, "sent": replies["time"]} if replies else {},
            "encoder": encoder or {},
        }
        kinds = tables(len(conditions.joints))
        filled = {name: _filled(name, kinds[name], columns) for name, columns in given.items()}
        return cls(conditions, filled, end)

    def __post_init__(self) -> None:
        """Freeze the tables."""
        kinds = tables(len(self.conditions.joints))
        whole = {name: self.tables.get(name, np.zeros(0, kind)) for name, kind in kinds.items()}
        frozen = {name: _frozen(canonical(rows)) for name, rows in whole.items()}
        object.__setattr__(self, "tables", frozen)

    def __repr__(self) -> str:
        """Return one line: arm, world, duration and outcome."""
        where = f"{self.conditions.arm.name!r} in {self.conditions.world!r}"
        lasted = f"{self.lasted:g} of {self.conditions.duration:g} s"
        return f"<RunLog of {where}: lasted {lasted}, ended {self.outcome}>"

    @property
    def outcome(self) -> Outcome:
        """How the run ended."""
        return Outcome.BROKEN_OFF if self.end is None else self.end.outcome

    @cached_property
    def events(self) -> tuple[LoggedEvent, ...]:
        """Changes of the phase, prompts and faults, in order."""
        return tuple(read_events(self.tables["event"]))

    @property
    def lasted(self) -> float:
        """Duration of the balancing [s]; without ticks, of the stream of setpoints."""
        if len(self.time) or not self.conditions.simulated:
            return round(len(self.time) * self.conditions.h, 9)
        return float(np.max(self.stream.time, initial=0.0))

    @property
    def digest(self) -> str:
        """SHA-256 of conditions, rows and end."""
        digest = Digest(self.conditions)
        for name, rows in self.tables.items():
            digest.update(name, rows)
        return digest.finish(self.end)

    @property
    def start(self) -> tuple[float, float, float, float]:
        """State at the release: x [m], x_dot [m/s], phi [rad], phi_dot [rad/s].

        On a rig it is the first prediction.
        """
        first = self.ticks[:1]
        return self.conditions.start or tuple(
            float(first[name].sum()) for name in ("x", "x_dot", "phi", "phi_dot")
        )  # pyright: ignore[reportReturnType]

    # Phases.

    def phase_ticks(self, *phases: Phase) -> IntArray:
        """Return the indices of the ticks in any of `phases`, shape (n,)."""
        states = [i for i, phase in enumerate(self.conditions.phases) if phase in phases]
        return np.flatnonzero(np.isin(self.tables["tick"]["state"], states))

    @cached_property
    def ticks(self) -> Rows:
        """Rows of the balancing without unknown numbers, shape (n,)."""
        rows = self.tables["tick"][self.phase_ticks(Phase.BALANCING)]
        known = [np.isfinite(np.atleast_2d(rows[c.name].T)).all(axis=0) for c in TABLES["tick"]]
        return _frozen(rows[np.all(known, axis=0)])

    @property
    def release(self) -> float:
        """Time of the release on the run's clock [s].

        Raises:
            RecordingError: The run did not reach balancing.
        """
        if self.conditions.simulated:
            return 0.0
        self.require_balancing()
        return float(self.ticks["time"][0])

    def require_balancing(self) -> None:
        """Reject a run without balancing.

        Raises:
            RecordingError: The run did not reach balancing.
        """
        if len(self.ticks):
            return
        if self.conditions.simulated:
            raise RecordingError("no policy ran; give a run in which one did")
        phase = self.last_phase.value if self.last_phase else "connecting"
        reason = f" ({self.end.reason})" if self.end else ""
        raise RecordingError(
            f"the run did not reach balancing, it ended while {phase}{reason}; give one that did"
        )

    @property
    def last_phase(self) -> Phase | None:
        """Last phase of a run on a rig before it stopped; None before the first tick."""
        states = reversed(self.tables["tick"]["state"].tolist())
        phases = (self.conditions.phases[state] for state in states)
        return next((phase for phase in phases if phase is not Phase.STOPPING), None)

    # Columns of the balancing.

    @cached_property
    def time(self) -> Array:
        """Start of each tick since the release [s], shape (n,)."""
        return _frozen(self.ticks["time"] - self._begin)

    x = _TickColumn()
    """Displacement of the flange from home along base x, as observed by the policy [m], shape (n,).

    With an encoder, this and the next three columns are predictions for the time at which the
    command takes effect.
    """
    x_dot = _TickColumn()
    """Velocity of the flange, as observed by the policy [m/s], shape (n,)."""
    phi = _TickColumn()
    """Angle of the pendulum from upright, as observed by the policy [rad], shape (n,)."""
    phi_dot = _TickColumn()
    """Angular velocity of the pendulum, as observed by the policy [rad/s], shape (n,)."""
    box = _TickColumn()
    """Box of the table that contains the state, shape (n,)."""
    u = _TickColumn()
    """Commanded acceleration of the flange along x [m/s^2], shape (n,)."""

    @property
    def tracked(self) -> Array:
        """Acceleration u' of the flange over the tick, on a rig of its reference [m/s^2]."""
        if len(self.truth.tracked):
            return self.truth.tracked
        return np.diff(self.x_dot, append=self.x_dot[-1:]) / self.conditions.h

    q = _TickColumn()
    """Joint positions commanded for the end of the tick [rad], shape (n, joints)."""
    dq = _TickColumn()
    """Joint velocities commanded for the end of the tick [rad/s], shape (n, joints)."""
    estimated_phi = _TickColumn()
    """Estimate of phi at the tick, without prediction [rad], shape (n,)."""
    estimated_phi_dot = _TickColumn()
    """Estimate of phi_dot at the tick [rad/s], shape (n,)."""
    bias = _TickColumn()
    """Estimate of the encoder's zero error [rad], shape (n,)."""

    @cached_property
    def truth(self) -> TruthColumns:
        """True state; in simulation only."""
        return TruthColumns(*(self.tables["truth"][name] for name in TruthColumns._fields))

    @cached_property
    def stream(self) -> JointSamples:
        """Setpoints as sent."""
        rows = self._while_balancing("stream")
        return JointSamples(_frozen(rows["time"] - self._begin), rows["q"])

    @cached_property
    def replies(self) -> JointSamples:
        """Joint positions as measured, on a rig half-way between request and reply."""
        rows = self._while_balancing("reply")
        rows = _frozen(rows[np.isfinite(rows["q"]).all(axis=1) & np.isfinite(rows["sent"])])
        measured = 0.5 * (rows["sent"] + rows["time"])
        return JointSamples(_frozen(measured - self._begin), rows["q"])

    @cached_property
    def encoder(self) -> EncoderSamples:
        """Counts of the encoder relative to the zero.

        Raises:
            ArtefactError: The log of a run on a rig does not contain the zero.
        """
        rows = self._while_balancing("encoder")
        zero = 0 if self.conditions.simulated or not len(rows) else round(self.encoder_zero)
        return EncoderSamples(_frozen(rows["time"] - self._begin), _frozen(rows["counts"] - zero))

    @property
    def _begin(self) -> float:
        return self.release if len(self.ticks) else 0.0

    def _while_balancing(self, table: str) -> Rows:
        """Return the rows of a table from one tick before the release to one after the last."""
        rows = self.tables[table]
        if self.conditions.simulated:
            return rows
        if not len(self.ticks):
            return rows[:0]
        h, time = self.conditions.h, rows["time"]
        first, last = self.ticks["time"][[0, -1]]
        return _frozen(rows[(time >= first - h) & (time <= last + h)])

    @property
    def encoder_zero(self) -> float:
        """Encoder counts of the hanging pendulum, up to whole turns.

        The end of the log contains the zero. In a log without an end, it follows from the last
        angle before the release and the newest count of that tick.

        Raises:
            ArtefactError: The log contains neither.
        """
        if self.end is not None and self.end.zero is not None:
            return self.end.zero
        armed, per_rev = self.phase_ticks(Phase.ARMED), self.conditions.counts_per_rev
        if len(armed) == 0 or per_rev is None:
            raise ArtefactError("the log does not contain the encoder's zero; give a complete log")
        tick, encoder = self.tables["tick"][armed[-1]], self.tables["encoder"]
        known = encoder["counts"][encoder["received"] <= tick["time"]]
        if len(known) == 0:
            raise ArtefactError("the log has no count before the release; give a complete log")
        return float(known[-1] - (np.pi - tick["estimated_phi"]) * per_rev / (2.0 * np.pi))

    # The file.

    def save(self, path: StrPath, *, command: str, inputs: Mapping[str, str] | None = None) -> None:
        """Write the run to `path` atomically.

        Args:
            path: The file; a missing folder is created.
            command: Command or function that created the run.
            inputs: Digests of the inputs, by name.

        Raises:
            ArtefactError: The log has no end.
            OutsideError: The disk rejects the file.
        """
        if self.end is None:
            raise ArtefactError("a log without an end cannot be written; copy its file")
        times = np.concatenate([rows["time"] for rows in self.tables.values()])
        first = float(times.min(initial=0.0))
        last = float(times.max(initial=self.lasted))
        encoder = LogEncoder(self.conditions, Provenance.now(command, inputs), first)
        for _ in encoder.write(self.tables):
            pass
        encoder.finish(last, self.end)
        write_whole(Path(path), encoder.take())

    @classmethod
    def load(cls, path: StrPath, *, damaged: bool = False) -> Self:
        """Read a run from `path`.

        Args:
            path: The file.
            damaged: Read a damaged log up to the damage, described by `damage`, instead of
                rejecting it.

        Raises:
            ArtefactError: The file is missing, corrupt, edited, not a run log, or of another
                version.
        """
        path = Path(path)
        content = read_mcap(path)
        entries = content.metadata.get(FORMAT, {})
        if not entries and content.damage:
            raise ArtefactError(f"{path} {content.damage}, in its header; record the run again")
        version = entries.get("version", "")
        if not (version.isascii() and version.isdecimal() and len(version) < 9 and int(version)):
            raise ArtefactError(f"{path} is no run log of Equipoise; give a file that it wrote")
        check_version(path, FORMAT, int(version), VERSION, "record the run again")
        damage, end, digest = content.damage, None, None
        try:
            conditions = RunConditions.model_validate_json(entries["conditions"], strict=True)
            provenance = Provenance.model_validate_json(entries["provenance"], strict=True)
            origin = float(entries["origin"])
            rows = {
                name: from_messages(
                    list(map(json.loads, content.messages.get(f"/{name}", ()))), kind
                )
                for name, kind in tables(len(conditions.joints)).items()
            }
            valid_states = np.isin(rows["tick"]["state"], range(len(conditions.phases)))
            if not (abs(origin) <= MAX_NUMBER and valid_states.all()):
                raise ValueError(origin)
            if written := content.messages.get("/end"):
                given = json.loads(written[-1])
                digest = given.pop("digest")
                end, damage = RunEnd.model_validate_json(json.dumps(given), strict=True), ""
        except FAULTS as error:
            raise _refusal(path, damage, error) from None
        if end is None:
            damage = damage or "lacks its end"
            rows = _without_partial_ticks(rows, conditions.h, origin + content.last)
        run = cls(conditions, rows, end, damage, provenance)
        if end is not None and run.digest != digest:
            raise ArtefactError(
                f"{path} does not match its digest: it was edited or damaged after it was "
                "written; record the run again"
            )
        if damage and not damaged:
            raise ArtefactError(
                f"{path}: {run.missing_part}; log explain and log export read the sound part, or "
                "record the run again"
            )
        return run

    @property
    def missing_part(self) -> str:
        """Sentence on the damage and the sound part; empty for a complete log."""
        if not self.damage:
            return ""
        time = self.tables["tick"]["time"]
        lasted = float(np.ptp(time)) + self.conditions.h if len(time) else 0.0
        return (
            f"the log {self.damage}; sound before that: {len(time):,} ticks, {lasted:.2f} s; what "
            "came after is not known"
        )


def _filled(name: str, kind: np.dtype[Any], columns: Mapping[str, Any]) -> Rows:
    """Return a table from its columns; an empty one without a column of times.

    Raises:
        ArtefactError: Columns differ in length, or values are not finite.
    """
    rows = np.zeros(len(columns.get("time", ())), kind)
    for column in TABLES[name]:
        if column.name not in columns:
            if column.kind in ("number", "joints"):
                rows[column.name] = np.nan
            continue
        given = np.asarray(columns[column.name])
        shape = rows[column.name].shape
        if given.shape not in ((), shape) and rows.size + given.size:
            raise ArtefactError(
                f"{column.name} of table {name} has shape {given.shape}, expected {shape}: give "
                "all columns of a table the same length, and postures one number per joint"
            )
        if not np.all(np.abs(given) <= MAX_NUMBER):
            raise ArtefactError(
                f"{column.name} of table {name} holds values that are not finite, or beyond "
                f"{MAX_NUMBER:g}; record the run again"
            )
        if column.kind == "whole" and np.any(np.round(given) != given):
            raise ArtefactError(
                f"{column.name} of table {name} holds values that are not whole numbers; round them"
            )
        rows[column.name] = given if given.size else 0
    return rows


def _frozen(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    values.flags.writeable = False
    return values


def _refusal(path: Path, damage: str, error: Exception) -> ArtefactError:
    """Return the error for a file with invalid content."""
    first = error.errors()[0] if isinstance(error, ValidationError) else None
    where = ".".join(map(str, first["loc"])) if first else ""
    if first is not None and first["type"] == "extra_forbidden":
        return ArtefactError(
            f"{path} is not a valid {FORMAT!r} file: this Equipoise does not know the field "
            f"{where}; upgrade it, or record the run again"
        )
    if damage:
        return ArtefactError(f"{path} {damage}, before the first tick; record the run again")
    what = f"{where}: {first['msg']}" if first else "its messages are incomplete"
    return ArtefactError(f"{path} is not a valid {FORMAT!r} file: {what}; record the run again")


def _without_partial_ticks(rows: Mapping[str, Rows], h: float, last: float) -> dict[str, Rows]:
    """Return tables without the last ticks, whose rows in other tables may be missing.

    Messages are in the order of time: a message one period after a tick proves that all rows of the
    tick are present.

    Args:
        rows: Rows of each table.
        h: Time between ticks [s].
        last: Time of the last message on the run's clock [s].
    """
    whole = int(np.sum(rows["tick"]["time"] + h <= last + 1e-9))
    if len(rows["truth"]):
        whole = min(whole, len(rows["truth"]))
    return dict(rows) | {name: rows[name][:whole] for name in ("tick", "truth")}
