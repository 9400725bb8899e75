"""Log of a run: the tables of the whole run, and the columns of the balancing.

`tables`, `events` and `end` hold the whole run: on a rig from the connection to rest, in simulation
from its first tick on. `ticks`, `truth`, `stream`, `replies` and `encoder` hold the balancing,
during which the policy acts; `time` is that of each tick since the first, the release. On a rig the
encoder's counts are then relative to the hanging pendulum, and the true state is unknown.

A truncated or damaged log is read up to the first damage, on request: a chunk counts only with its
checksum, messages only with consecutive sequence numbers.
"""

import csv
import hashlib
import io
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from equipoise.arrays import Array, IntArray
from equipoise.control.ticks import OperatorMessage
from equipoise.errors import ArtefactError, RecordingError
from equipoise.files import DIGEST_PREFIX, Provenance, StrPath, shortened, write_atomically
from equipoise.log.columns import Rows, from_messages, tables, to_csv, unknown_rows
from equipoise.log.conditions import RunConditions, RunEnd
from equipoise.log.recorder import read_events
from equipoise.log.writer import FORMAT, LogEncoder
from equipoise.outcomes import End, Outcome, Phase


def _read_mcap(path: Path) -> tuple[Mapping[str, str], Mapping[str, list[bytes]], str]:
    """Return the entries of the metadata, the messages by topic, and the damage as a clause.

    Raises:
        ArtefactError: The file is missing, cannot be read, is no MCAP file, or was changed.
    """
    from mcap.records import Channel, DataEnd, Message, Metadata
    from mcap.stream_reader import StreamReader

    try:
        file = io.BytesIO(path.read_bytes())
    except OSError as error:
        raise ArtefactError(f"cannot read {path}: {error.strerror}; check the path") from None
    entries: dict[str, str] = {}
    messages: dict[str, list[bytes]] = defaultdict(list)
    topics: dict[int, str] = {}
    count = 0
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Metadata) and record.name == FORMAT:
                entries = record.metadata
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                if record.sequence != count:
                    raise ValueError("a chunk is missing")
                messages[topics[record.channel_id]].append(record.data)
                count += 1
            elif isinstance(record, DataEnd):
                break
    except Exception as error:  # a damaged length raises exceptions of any type
        if isinstance(getattr(error, "record", None), DataEnd):
            raise ArtefactError(
                f"{path} does not match its checksum: it was changed after it was written; "
                "record the run again"
            ) from None
        return entries, messages, f"is cut short or damaged at byte {file.tell():,}"
    return entries, messages, ""


def _without_partial_ticks(rows: Mapping[str, Rows], run: RunConditions) -> dict[str, Rows]:
    """Return tables without the last ticks, whose rows in other tables may be missing.

    Messages are in the order of time: a message one period after a tick proves that all rows of the
    tick are present.

    Args:
        rows: Rows of each table.
        run: Conditions of the run.
    """
    last = max((float(table["time"].max()) for table in rows.values() if len(table)), default=0.0)
    complete = int(np.sum(rows["tick"]["time"] + run.h <= last + 1e-9))
    if run.simulated:
        complete = min(complete, len(rows["truth"]))
    return dict(rows) | {name: rows[name][:complete] for name in ("tick", "truth")}


@dataclass(frozen=True, eq=False, repr=False)
class RunLog:
    """One run.

    `stream`, `replies` and `encoder` raise `RecordingError` in a run without balancing.
    """

    conditions: RunConditions
    """Place and settings of the run."""
    tables: Mapping[str, Rows]
    """Rows of each table of `equipoise.log.columns`, as structured arrays."""
    end: RunEnd | None
    """End of the run; None for a log without one."""
    damage: str = ""
    """Sentence on the damage and the sound part; empty for a complete log."""

    def __repr__(self) -> str:
        """Return one line: arm, world, duration and outcome."""
        where = f"{self.conditions.arm.name!r} in {self.conditions.world!r}"
        survival = f"{self.survival:g} of {self.conditions.duration:g} s"
        return f"<RunLog of {where}: survived {survival}, ended {self.outcome}>"

    @property
    def outcome(self) -> Outcome:
        """How the run ended."""
        return Outcome.BROKEN_OFF if self.end is None else self.end.outcome

    @property
    def ending(self) -> End:
        """End of the run; of a broken-off log, the evidence is its last stop or fault."""
        if self.end is not None:
            return End(self.end.outcome, self.end.evidence)
        stops = [event.text for event in self.events if event.name in ("stopping", "fault")]
        return End(Outcome.BROKEN_OFF, {"text": stops[-1]} if stops else {})

    @cached_property
    def events(self) -> tuple[OperatorMessage, ...]:
        """Changes of the phase, prompts and faults, in order."""
        return tuple(read_events(self.tables["event"]))

    @property
    def survival(self) -> float:
        """Duration of the balancing [s]; of an excitation, of the stream of setpoints."""
        if self.outcome is Outcome.EXCITED:
            return float(np.max(self.stream.time, initial=0.0))
        return round(len(self.time) * self.conditions.h, 9)

    @property
    def digest(self) -> str:
        """SHA-256 of conditions, rows and end."""
        end = self.end.model_dump_json() if self.end else ""
        digest = hashlib.sha256(f"{self.conditions.model_dump_json()}\n{end}".encode())
        for name, rows in self.tables.items():
            digest.update(name.encode() + hashlib.sha256(rows.tobytes()).digest())
        return DIGEST_PREFIX + digest.hexdigest()

    # Phases.

    def phase_ticks(self, *phases: Phase) -> IntArray:
        """Return the indices of the ticks in any of `phases`, shape (n,)."""
        states = [i for i, phase in enumerate(self.conditions.phases) if phase in phases]
        return np.flatnonzero(np.isin(self.tables["tick"]["state"], states))

    @cached_property
    def ticks(self) -> Any:
        """Ticks of the balancing without unknown numbers: attributes as the columns of `tick`.

        With an encoder, `x`, `x_dot`, `phi` and `phi_dot` are predictions for the time at which the
        command takes effect.
        """
        rows = self.tables["tick"][self.phase_ticks(Phase.BALANCING)]
        known = [np.isfinite(rows[name]) for name in ("x", "x_dot", "phi", "phi_dot", "u")]
        known += [np.isfinite(rows[name]).all(axis=1) for name in ("q", "dq")]
        return rows[np.all(known, axis=0)].view(np.recarray)

    @property
    def release(self) -> float:
        """Time of the release on the run's clock [s]; zero without balancing."""
        return float(self.ticks.time[0]) if len(self.ticks) else 0.0

    def require_balancing(self) -> None:
        """Reject a run without balancing.

        Raises:
            RecordingError: The run did not reach balancing.
        """
        if not len(self.ticks):
            reason = f" ({self.end.reason})" if self.end else ""
            raise RecordingError(f"the run did not reach balancing{reason}; give one that did")

    @property
    def last_phase(self) -> Phase | None:
        """Last phase of a run before it stopped; None before the first tick."""
        states = reversed(self.tables["tick"]["state"].tolist())
        phases = (self.conditions.phases[state] for state in states)
        return next((phase for phase in phases if phase is not Phase.STOPPING), None)

    # Rows of the balancing.

    @cached_property
    def time(self) -> Array:
        """Start of each tick since the release [s], shape (n,)."""
        return self.ticks.time - self.release

    @cached_property
    def truth(self) -> Any:
        """True state at each tick: attributes as the columns of `truth`; in simulation only."""
        rows = self.tables["truth"]
        return (rows[self.phase_ticks(Phase.BALANCING)] if len(rows) else rows).view(np.recarray)

    @cached_property
    def stream(self) -> Any:
        """Setpoints as sent: `time` since the release [s], joints `q` [rad]."""
        return self._while_balancing("stream")

    @cached_property
    def replies(self) -> Any:
        """Measured joints: `time` since the release [s], `q` [rad], with those of `reply`.

        On a rig they count as measured half-way between request and reply.
        """
        rows = self._while_balancing("reply")
        rows = rows[np.isfinite(rows["q"]).all(axis=1) & np.isfinite(rows["sent"])]
        rows["time"] = 0.5 * (rows["sent"] - self.release + rows["time"])
        return rows

    @cached_property
    def encoder(self) -> Any:
        """Samples: `time` since the release [s], `counts` relative to the zero.

        Raises:
            ArtefactError: The log of a run on a rig does not contain the zero.
        """
        rows = self._while_balancing("encoder")
        if len(rows) and not self.conditions.simulated:
            rows["counts"] -= round(self.encoder_zero)
        return rows

    def _while_balancing(self, table: str) -> Any:
        """Return the rows from one tick before the release to one after the last.

        Their times count from the release. Of an excitation, all rows are returned.
        """
        rows, h = self.tables[table], self.conditions.h
        if len(self.tables["tick"]) or not self.conditions.simulated:
            self.require_balancing()
            first, last = self.ticks.time[[0, -1]]
            rows = rows[(rows["time"] >= first - h) & (rows["time"] <= last + h)]
        rows = rows.copy()
        rows["time"] -= self.release
        return rows.view(np.recarray)

    @property
    def encoder_zero(self) -> float:
        """Encoder counts of the hanging pendulum, up to whole turns.

        Raises:
            ArtefactError: The log is cut short before the release.
        """
        if self.end and self.end.zero is not None:
            return self.end.zero
        # The last angle before the release, and its newest count.
        armed, per_rev = self.phase_ticks(Phase.ARMED), self.conditions.counts_per_rev
        tick, encoder = self.tables["tick"][armed[-1:]], self.tables["encoder"]
        known = encoder["counts"][encoder["received"] <= tick["time"].sum()]
        if len(tick) == 0 or per_rev is None or len(known) == 0:
            raise ArtefactError("the log does not contain the encoder's zero; give a complete log")
        angle = np.pi - float(tick["estimated_phi"][0])
        return float(known[-1] - angle * per_rev / (2.0 * np.pi))

    # The file.

    def save(
        self, path: StrPath, *, command: str = "python", inputs: Mapping[str, str] | None = None
    ) -> None:
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
        first, stream = float(times.min(initial=0.0)), io.BytesIO()
        encoder = LogEncoder(stream, self.conditions, Provenance.now(command, inputs), first)
        encoder.write(self.tables)
        encoder.finish(float(times.max(initial=self.survival)), self.end)
        write_atomically(Path(path), stream.getvalue())

    def export(self, folder: Path) -> list[Path]:
        """Write each table as a CSV file, with units in the header and a column for each joint.

        Args:
            folder: Folder of the files, created if missing; existing files are replaced.

        Returns:
            The files that were written.

        Raises:
            OutsideError: A file cannot be written.
            RecordingError: The log holds no rows.
        """
        if not any(map(len, self.tables.values())):
            raise RecordingError("the log ends before its first row; there is nothing to export")
        made: list[Path] = []
        for name, rows in self.tables.items():
            if not len(rows) and (self.conditions.simulated or name == "truth"):
                continue
            columns, text = to_csv(name, rows, self.conditions.joints), io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
            made.append(folder / f"{name}.csv")
            write_atomically(made[-1], text.getvalue())
        return made

    @classmethod
    def load(cls, path: StrPath, *, damaged: bool = False) -> Self:
        """Read a run from `path`.

        Args:
            path: The file.
            damaged: Read a damaged log up to the damage, described by `damage`, instead of
                rejecting it.

        Raises:
            ArtefactError: The file is missing, corrupt, not a run log, or of another version.
        """
        entries, messages, damage = _read_mcap(Path(path))
        if not entries:
            raise ArtefactError(
                f"{path} is no run log, or damaged at its begin; give a log that deploy wrote"
            )
        end = None
        try:
            conditions = RunConditions.model_validate_json(entries["conditions"], strict=True)
            rows = {
                name: from_messages([json.loads(message) for message in messages[f"/{name}"]], kind)
                for name, kind in tables(len(conditions.joints)).items()
            }
            if not np.isin(rows["tick"]["state"], range(len(conditions.phases))).all():
                raise ValueError("state is no phase of the run")
            if written := messages["/end"]:
                end, damage = RunEnd.model_validate_json(written[-1], strict=True), ""
        except (LookupError, TypeError, AttributeError, ValueError, RecursionError) as error:
            what = damage or f"is not a valid {FORMAT!r} file: {shortened(str(error), 200)}"
            raise ArtefactError(f"{path} {what}; record the run again") from None
        if end is None:
            rows = _without_partial_ticks(rows, conditions)
            ticks = len(rows["tick"])
            damage = (
                f"the log {damage or 'lacks its end'}; sound before that: {ticks:,} ticks, "
                f"{ticks * conditions.h:.2f} s; what came after is not known"
            )
        if damage and not damaged:
            raise ArtefactError(
                f"{path}: {damage}; log explain and log export read the sound part, or record the "
                "run again"
            )
        return cls(conditions, rows, end, damage)


def simulated_log(
    conditions: RunConditions, end: RunEnd, columns_of: Mapping[str, Mapping[str, Any]]
) -> RunLog:
    """Create a simulated run from the columns of its tables, by the names of both.

    Tables may be missing; so may columns except `time`, whose values are then unknown.
    """
    filled = dict[str, Rows]()
    for name, kind in tables(len(conditions.joints)).items():
        columns = columns_of.get(name, {"time": ()})
        filled[name] = unknown_rows(kind, len(columns["time"]))
        for column, values in columns.items():
            filled[name][column] = values
    return RunLog(conditions, filled, end)
