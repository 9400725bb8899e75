"""Views of a run's log: its end, its pendulum, and its tables as CSV."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy.typing as npt

from equipoise.artefacts import write_whole
from equipoise.errors import RecordingError
from equipoise.logs.columns import TABLES, Rows
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import PendulumParameters
from equipoise.outcomes import End, Outcome


def load_run(path: Path) -> RunLog:
    """Read a run for measurements, damaged or not.

    Raises:
        ArtefactError: The file is missing, not readable, or not a run log.
        RecordingError: A run on a rig did not reach the balancing.
    """
    run = RunLog.load(path, damaged=True)
    try:
        if not run.conditions.simulated:
            run.require_balancing()
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    return run


def ending(run: RunLog) -> End:
    """Return the end of a run; of a broken-off log, the evidence is its last stop or fault."""
    if run.end is not None:
        return End(run.end.outcome, run.end.evidence)
    stops = [event.text for event in run.events if event.name in ("stopping", "fault")]
    return End(Outcome.BROKEN_OFF, {"text": stops[-1]} if stops else {})


def pendulum_of(run: RunLog) -> PendulumParameters:
    """Return the pendulum of a run: the true one in simulation, the assumed one on a rig."""
    of = run.conditions.pendulum
    return PendulumParameters(of["w2"], of["k"], of["c"], of["coulomb"], of["drag"])


# CSV.


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
                yield column._replace(name=f"{column.name}_{joint}").header, _plain(of_joint)
        else:
            yield column.header, _plain(values)


def _plain(values: npt.NDArray[Any]) -> list[Any]:
    """Return values for CSV: decoded text, and an empty cell for NaN."""
    if values.dtype.kind == "S":
        return [text.decode("utf-8", "replace") for text in values.tolist()]
    return ["" if value != value else value for value in values.tolist()]
