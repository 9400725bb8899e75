"""Tables of a run's log as CSV, with units in the header."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from equipoise.artefacts import write_whole
from equipoise.errors import RecordingError
from equipoise.logs.columns import TABLES, Rows, plain
from equipoise.logs.run_log import RunLog


def export(run: RunLog, folder: Path) -> list[Path]:
    """Write each table of a log as a CSV file, with units in the header.

    Args:
        run: The log.
        folder: Folder of the files, created if missing; existing files are replaced.

    Returns:
        The files that were written.

    Raises:
        OutsideError: A file cannot be written.
        RecordingError: The log holds no rows.
    """
    if not any(map(len, run.tables.values())):
        raise RecordingError("the log ends before its first row; there is nothing to export")
    made: list[Path] = []
    for name, rows in run.tables.items():
        if not len(rows) and (run.conditions.simulated or name == "truth"):
            continue
        columns = list(_columns(name, rows, run.conditions.joints))
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([header for header, _ in columns])
        writer.writerows(zip(*(values for _, values in columns), strict=True))
        made.append(folder / f"{name}.csv")
        write_whole(made[-1], text.getvalue().encode())
    return made


def _columns(table: str, rows: Rows, joints: tuple[str, ...]) -> Iterator[tuple[str, list[Any]]]:
    """Yield header and values of each column; a posture has one column per joint."""
    for column in TABLES[table]:
        values = rows[column.name]
        if column.kind == "joints":
            for joint, of_joint in zip(joints, values.T, strict=True):
                yield column._replace(name=f"{column.name}_{joint}").header, plain(of_joint)
        else:
            yield column.header, plain(values)
