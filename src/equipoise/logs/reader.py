"""Reader of run logs, up to the first damage.

A truncated or damaged log is read up to the first damage, on request: a chunk counts only with its
checksum, messages only with consecutive sequence numbers.
"""

import json
from collections import defaultdict
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np

from equipoise.artefacts import Provenance, shortened
from equipoise.errors import ArtefactError
from equipoise.logs.columns import Rows, from_messages, tables
from equipoise.logs.conditions import RunConditions, RunEnd
from equipoise.logs.writer import FORMAT


def read_log(
    path: Path,
) -> tuple[RunConditions, Mapping[str, Rows], RunEnd | None, str, Provenance]:
    """Read a log up to the first damage; the values are those of a `RunLog`.

    Raises:
        ArtefactError: The file is missing, damaged before its conditions, not a run log, or of
            another version.
    """
    entries, messages, damage = _read_mcap(path)
    if not entries:
        raise ArtefactError(f"{path} {damage or 'is no run log'}; give a log that deploy wrote")
    end = None
    try:
        conditions = RunConditions.model_validate_json(entries["conditions"], strict=True)
        provenance = Provenance.model_validate_json(entries["provenance"], strict=True)
        rows = {
            name: from_messages([json.loads(each) for each in messages[f"/{name}"]], kind)
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
        rows = _without_partial_ticks(rows, conditions.h)
        ticks = len(rows["tick"])
        damage = (
            f"the log {damage or 'lacks its end'}; sound before that: {ticks:,} ticks, "
            f"{ticks * conditions.h:.2f} s; what came after is not known"
        )
    return conditions, rows, end, damage, provenance


def _read_mcap(path: Path) -> tuple[Mapping[str, str], Mapping[str, list[bytes]], str]:
    """Return the entries of the metadata, the messages by topic, and the damage as a clause.

    Raises:
        ArtefactError: The file is missing, cannot be read, is no MCAP file, or was changed.
    """
    from mcap.exceptions import InvalidMagic
    from mcap.records import Channel, DataEnd, Message, Metadata
    from mcap.stream_reader import StreamReader

    try:
        file = BytesIO(path.read_bytes())
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
    except InvalidMagic:
        raise ArtefactError(f"{path} is not an MCAP file; give a log that deploy wrote") from None
    except Exception as error:  # a damaged length raises exceptions of any type
        if isinstance(getattr(error, "record", None), DataEnd):
            raise ArtefactError(
                f"{path} does not match its checksum: it was changed after it was written; "
                "record the run again"
            ) from None
        return entries, messages, f"is cut short or damaged at byte {file.tell():,}"
    return entries, messages, ""


def _without_partial_ticks(rows: Mapping[str, Rows], h: float) -> dict[str, Rows]:
    """Return tables without the last ticks, whose rows in other tables may be missing.

    Messages are in the order of time: a message one period after a tick proves that all rows of the
    tick are present.

    Args:
        rows: Rows of each table.
        h: Time between ticks [s].
    """
    last = max((float(table["time"].max()) for table in rows.values() if len(table)), default=0.0)
    whole = int(np.sum(rows["tick"]["time"] + h <= last + 1e-9))
    if len(rows["truth"]):
        whole = min(whole, len(rows["truth"]))
    return dict(rows) | {name: rows[name][:whole] for name in ("tick", "truth")}
