"""Recorded motions of the pendulum, and their CSV files.

theta is measured from hanging, in radians, and increases with the encoder's counts; theta + phi =
pi. A recording holds theta, or its rate from a gyro. The file has a header and one sample per
line::

    time_s,theta_rad        or time_ms, time_us; theta_deg, counts, rate_rad_s
    0.000,-1.618429

Semicolons and tabs are accepted separators, also with decimal commas. Text is UTF-8. Other columns
are ignored. Angles are unwrapped: a jump by more than half a turn between two samples comes from a
recorder that wraps the angle.
"""

import codecs
import csv
import hashlib
import io
import math
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import DIGEST_PREFIX, MEBIBYTE, StrPath, read_bytes, shortened, write_whole
from equipoise.errors import RecordingError
from equipoise.printable import printable

TIME: Final = "time_s"
"""Name of the column of time stamps [s]."""
TIMES: Final = {TIME: 1.0, "time_ms": 1e-3, "time_us": 1e-6}
"""Accepted columns of time stamps, with their units [s]; a file has one."""
QUANTITIES: Final = ("theta_rad", "theta_deg", "counts", "rate_rad_s")
"""Accepted columns of the motion; a file has one."""

MAX_RECORDING_SIZE: Final = 128 * MEBIBYTE
"""Size limit of a recording [bytes]: an hour at 1 kHz with six columns."""
MAX_SAMPLES: Final = 5_000_000
"""Limit on the number of samples: more than an hour at 1 kHz; a swing lasts minutes."""
MAX_NUMBER: Final = 1e18
"""Limit on a number in a recording: nanoseconds since 1970 have 19 digits."""
MAX_TIME: Final = 1e10
"""Limit on a time stamp [s]: 300 years; seconds since 1970 are below, milliseconds above."""
MAX_VALUE: Final = 1e9
"""Limit on an angle [rad] or a rate [rad/s], beyond the range of any encoder."""
SEPARATORS: Final = (",", ";", "\t")
"""Separators between columns."""
FOREIGN: Final = {
    b"PK\3\4": "a ZIP file or a spreadsheet",
    b"\x1f\x8b": "a gzip file",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}
"""Kinds of files that are no UTF-8 text, by their first bytes; named in the refusal."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion of the pendulum over time, with read-only arrays."""

    time: npt.NDArray[np.float64]
    """Time stamps [s], increasing, shape (n,)."""
    theta: npt.NDArray[np.float64] | None = None
    """Angle from hanging [rad], shape (n,); None if a gyro recorded the rate."""
    theta_dot: npt.NDArray[np.float64] | None = None
    """Rate of the angle [rad/s], shape (n,); None if the angle was recorded."""
    x_ddot: npt.NDArray[np.float64] | None = None
    """Acceleration of the pivot along x [m/s^2], shape (n,); None for a pivot at rest."""
    resolution: float = 0.0
    """Smallest step of the recorded values [rad], or [rad/s] for a rate; 0 if unknown."""
    source: str = "unnamed"
    """Name of the file."""
    sha256: str = ""
    """SHA-256 of the file; by default that of the samples."""
    released: bool = False
    """Whether the pendulum swings freely from the first sample, without a search for the
    release."""

    def __post_init__(self) -> None:
        """Validate the arrays and make them read-only.

        Raises:
            RecordingError: Angle and rate are both given or both missing, shapes differ, values are
                not finite, or time does not increase.
        """
        if (self.theta is None) == (self.theta_dot is None):
            raise RecordingError("a trajectory holds an angle or a rate; give theta or theta_dot")
        digest = hashlib.sha256()
        for name in ("time", "theta", "theta_dot", "x_ddot"):
            if (given := getattr(self, name)) is None:
                continue
            values = np.array(given, dtype=np.float64)
            if values.shape != (expected := (len(self.time),)):
                shape = f"shape {values.shape}, expected {expected}"
                raise RecordingError(f"{name} has {shape}: give one value per time stamp")
            if np.any(wrong := ~np.isfinite(values)):
                sample = f"sample {_first(wrong)} of {name}"
                raise RecordingError(f"{sample} is not a finite number; remove it")
            digest.update(name.encode() + values.tobytes())
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if np.any(late := np.diff(self.time) <= 0.0):
            raise RecordingError(
                f"time does not increase at sample {_first(late) + 1}; "
                "remove repeated samples or sort the recording"
            )
        if not self.sha256:
            object.__setattr__(self, "sha256", DIGEST_PREFIX + digest.hexdigest())

    @property
    def values(self) -> npt.NDArray[np.float64]:
        """Recorded values: the angle [rad], or the rate [rad/s]; shape (n,)."""
        recorded = self.theta if self.theta is not None else self.theta_dot
        return np.empty(0) if recorded is None else recorded


def read_swing(
    path: StrPath,
    *,
    counts_per_rev: int | None = None,
    from_upright: bool = False,
    start: float | None = None,
    end: float | None = None,
    columns: str | None = None,
) -> Trajectory:
    """Read a recorded swing from a CSV file.

    Args:
        path: The file.
        counts_per_rev: Encoder counts per revolution (after x4); required for a column `counts`.
        from_upright: The angle in the file is phi, zero when upright, instead of theta.
        start: Begin of the used part [s]; the pendulum is assumed to swing freely from there.
        end: End of the used part [s].
        columns: Names of the columns in their order, separated by commas, for a file with no header
            or another one; e.g. "time_s,theta_deg".

    Returns:
        The swing, as an angle from hanging or its rate.

    Raises:
        RecordingError: The file is missing or too large, has other columns, holds a value that is
            not a finite number, its time does not increase, or no samples are left.
    """
    path = Path(path)
    data = read_bytes(path, MAX_RECORDING_SIZE, "a recording", RecordingError)
    table = _table(path, data, columns)
    stamps, recorded = _samples(path, table)
    quantity, second = table.quantity, TIMES[table.time]
    if quantity == "counts" and not (counts_per_rev and counts_per_rev > 0):
        raise RecordingError(
            f"{path} holds encoder counts, but the counts per revolution are "
            f"{'not given' if counts_per_rev is None else counts_per_rev}; "
            "give them (after x4) with --counts-per-rev"
        )
    if np.any(late := np.diff(stamps) <= 0.0):
        i = _first(late) + 1
        line = next(islice(_rows(path, table), i, None))[0]
        raise RecordingError(
            f"{path}, line {line}: time does not increase, {table.time} is {stamps[i]:.10g} after "
            f"{stamps[i - 1]:.10g}; remove repeated samples or sort the recording"
        )
    turn = 2.0 * math.pi
    units = {"theta_deg": math.pi / 180.0, "counts": turn / (counts_per_rev or 1)}
    unit = units.get(quantity, 1.0)
    resolution = unit if quantity == "counts" else unit * _step(recorded)
    stamps, values = second * stamps, unit * recorded
    if (latest := float(np.max(np.abs(stamps)))) > MAX_TIME:
        raise RecordingError(
            f"{path}: {table.time} reaches {latest / second:.4g}, three hundred years and more; is "
            "it in another unit? Name its column time_ms or time_us where it is"
        )
    if (largest := float(np.max(np.abs(values)))) > MAX_VALUE:
        raise RecordingError(
            f"{path}: {quantity} reaches {largest / unit:.4g}, expected an angle or a rate below "
            f"{MAX_VALUE / unit:.4g}; correct or remove such lines"
        )
    is_rate = quantity == "rate_rad_s"
    if from_upright:
        values = -values if is_rate else math.pi - values
    keep = stamps >= (-math.inf if start is None else start - 1e-9)
    keep &= stamps < (math.inf if end is None else end + 1e-9)
    time, values = stamps[keep], values[keep]
    if time.size < 2:
        if start is None and end is None:
            cure = "record a swing of a few periods, with ten samples or more in each"
            raise RecordingError(f"{path} holds a single sample; {cure}")
        begin, stop = "its start" if start is None else start, "its end" if end is None else end
        raise RecordingError(
            f"{path} has {'one sample' if time.size else 'no samples'} between {begin} and {stop}; "
            f"it lasts from {stamps[0]:.10g} s to {stamps[-1]:.10g} s: choose --start and --end "
            "inside"
        )
    if not is_rate:
        values = np.unwrap(values)
        values = values - turn * np.round(np.median(values) / turn)
    return Trajectory(
        time=time,
        theta=None if is_rate else values,
        theta_dot=values if is_rate else None,
        resolution=resolution,
        source=printable(path.name),
        sha256=DIGEST_PREFIX + hashlib.sha256(data).hexdigest(),
        released=start is not None,
    )


def write_swing(path: StrPath, trajectory: Trajectory) -> None:
    """Write a swing as a CSV file, without loss of precision.

    Raises:
        OutsideError: The disk rejects the file.
    """
    path = Path(path)
    quantity = "theta_rad" if trajectory.theta is not None else "rate_rad_s"
    rows = zip(trajectory.time.tolist(), trajectory.values.tolist(), strict=True)
    write_whole(path, f"{TIME},{quantity}\n" + "".join(f"{t!r},{value!r}\n" for t, value in rows))


class _Table(NamedTuple):
    """Text of a recording, and its two columns."""

    text: bytes
    """Text in UTF-8 with decimal points."""
    separator: str
    """One of `SEPARATORS`."""
    skip: int
    """Number of lines before the first sample: 1 for a header, else 0."""
    names: tuple[str, ...]
    """Names of all columns."""
    time: str
    """Name of the column of time stamps."""
    quantity: str
    """Name of the column of recorded values."""


def _table(path: Path, data: bytes, columns: str | None) -> _Table:
    """Detect separator, header and columns of a recording."""
    text = _utf8(path, data)
    if (count := text.count(b"\n")) > MAX_SAMPLES:
        raise RecordingError(
            f"{path} has {count:,} lines, expected at most {MAX_SAMPLES:,}; cut it, or keep every "
            "tenth sample"
        )
    first = text.split(b"\n", 1)[0].decode().strip()
    if b"\0" in text[:4096] or any(ord(letter) < 32 and letter != "\t" for letter in first):
        raise RecordingError(
            f"{path} is not text; expected a CSV file with the columns {TIME} and one of "
            f"{', '.join(QUANTITIES)}"
        )
    separator = max(SEPARATORS, key=first.count) if ";" in first or "\t" in first else ","
    if separator != ",":
        text = text.replace(b",", b".")
        first = first.replace(",", ".")
    cells = tuple(cell.strip() for cell in first.split(separator))
    with suppress(csv.Error):
        cells = tuple(map(str.strip, next(csv.reader([first], delimiter=separator), [])))
    headless = bool(first) and all(_is_number(cell) for cell in cells)
    names = tuple(name.strip() for name in columns.split(",")) if columns else cells
    times = [name for name in names if name in TIMES]
    found = [name for name in names if name in QUANTITIES]
    expected = f"{', '.join(TIMES)} and one of {', '.join(QUANTITIES)}"
    if headless and not columns:
        raise RecordingError(
            f"{path} has no header, its first line is {shortened(first)!r}; name its columns, "
            f"for example --columns {TIME},theta_deg, or in a line above"
        )
    if len(times) != 1 or len(found) != 1:
        raise RecordingError(
            f"{path} has the columns {shortened(', '.join(names), 80) or '(none)'}; expected "
            f"one of {expected}, separated by a comma, a semicolon or a tab: rename the columns in "
            "its first line, or name them all in their order with --columns"
        )
    table = _Table(text, separator, 0 if headless else 1, names, times[0], found[0])
    _, row = next(_rows(path, table), (0, names))
    if len(row) > len(names) + 1:
        raise RecordingError(
            f"{path} has {len(row)} cells in its first line of numbers, expected {len(names)}; "
            "where decimals have commas, separate the columns by semicolons"
        )
    return table


def _utf8(path: Path, data: bytes) -> bytes:
    """Return the text in UTF-8, without a byte order mark and with line feeds alone."""
    found = next((kind for start, kind in FOREIGN.items() if data.startswith(start)), "")
    if not found and b"\0" in data[:2]:
        found = "UTF-16"
    if not found:
        try:
            data.decode()
        except UnicodeDecodeError:
            found = "not UTF-8"
    if found:
        raise RecordingError(f"{path} is {found}; save the recording as CSV in UTF-8")
    data = data.removeprefix(codecs.BOM_UTF8)
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell  # `float` accepts 1_000 and the digits of all scripts


def _samples(path: Path, table: _Table) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return time stamps and recorded values, each in the unit of its column, shape (n,)."""
    at = [table.names.index(name) for name in (table.time, table.quantity)]
    columns = np.full((1, 2), np.nan)
    with warnings.catch_warnings(), suppress(ValueError):
        warnings.simplefilter("ignore")  # about a file without samples
        columns = np.loadtxt(
            io.BytesIO(table.text),
            delimiter=table.separator,
            skiprows=table.skip,
            usecols=at,
            comments=None,
            quotechar='"',
            encoding="utf-8",
            ndmin=2,
        )
    if not np.all(np.abs(columns) <= MAX_NUMBER):
        # The slow path names the first invalid line and skips blank lines.
        named = list(zip((table.time, table.quantity), at, strict=True))
        cells = (
            _number(path, line, *column, row)
            for line, row in _rows(path, table)
            for column in named
        )
        columns = np.fromiter(cells, np.float64).reshape(-1, 2)
    if not len(columns):
        raise RecordingError(f"{path} holds no samples; record a swing of a few periods")
    return np.ascontiguousarray(columns[:, 0]), np.ascontiguousarray(columns[:, 1])


def _rows(path: Path, table: _Table) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each line with samples, and its cells."""
    lines = io.TextIOWrapper(io.BytesIO(table.text), encoding="utf-8", newline="")
    reader = csv.reader(lines, delimiter=table.separator)
    try:
        for row in reader:
            if reader.line_num > table.skip and any(cell.strip() for cell in row):
                yield reader.line_num, row
    except csv.Error as error:
        where = f"{path}, line {reader.line_num}"
        raise RecordingError(f"{where}: {error}; correct or remove the line") from None


def _number(path: Path, line: int, name: str, at: int, row: list[str]) -> float:
    cell = row[at].strip() if at < len(row) else ""
    value = float(cell) if _is_number(cell) else math.nan
    if not abs(value) <= MAX_NUMBER:
        raise RecordingError(
            f"{path}, line {line}: {name} is {shortened(cell, 40)!r}, expected a finite number "
            "such as -1.25 or 3e-4; correct or remove the line"
        )
    return value


def _step(values: npt.NDArray[np.float64]) -> float:
    """Return the smallest step between distinct values, ignoring rounding."""
    steps = np.diff(np.unique(values))
    real = steps[steps > 1e-12 * np.max(np.abs(values))]
    return float(real.min()) if real.size else 0.0


def _first(flags: npt.NDArray[np.bool_]) -> int:
    return int(np.flatnonzero(flags)[0])
