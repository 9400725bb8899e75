"""A recorded motion of the pendulum, and the CSV file that carries one.

theta is measured from hanging, in radians, and grows with the encoder's counts; theta + phi = pi.
A recording gives theta, or its rate from a gyro. The file has a header and one sample per line::

    time_s,theta_rad        or theta_deg, or counts, or rate_rad_s
    0.000,-1.618429

Further columns are ignored. An angle that jumps by more than half a turn from one sample to the
next was wrapped by its recorder, and is unwrapped.
"""

import csv
import hashlib
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import DIGEST_PREFIX, write_whole
from equipoise.errors import RecordingError
from equipoise.printable import printable

TIME: Final = "time_s"
"""Name of the column of time stamps [s]."""
QUANTITIES: Final = ("theta_rad", "theta_deg", "counts", "rate_rad_s")
"""Names of the columns that a motion can come in; a file has one of them."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion of the pendulum against time; its arrays cannot be written to."""

    time: npt.NDArray[np.float64]
    """Time stamps [s], increasing, shape (n,)."""
    theta: npt.NDArray[np.float64] | None = None
    """Angle from hanging [rad], shape (n,); none where a gyro recorded the rate."""
    theta_dot: npt.NDArray[np.float64] | None = None
    """Rate of the angle [rad/s], shape (n,); none where the angle was recorded."""
    x_ddot: npt.NDArray[np.float64] | None = None
    """Acceleration of the pivot along x [m/s^2], shape (n,); none where the pivot is at rest."""
    resolution: float = 0.0
    """Smallest step of the recorded values [rad], or [rad/s] for a rate; 0 where unknown."""
    source: str = "unnamed"
    """Where it comes from: the name of the file."""
    sha256: str = ""
    """SHA-256 of what it was read from; of the samples themselves if nothing is given."""
    released: bool = False
    """The first sample is known to swing freely, so that nobody looks for the release."""

    def __post_init__(self) -> None:
        """Check the shapes, and freeze the arrays.

        Raises:
            RecordingError: Not exactly one of angle and rate, shapes that differ, values that are
                no numbers, or time that does not increase.
        """
        if (self.theta is None) == (self.theta_dot is None):
            raise RecordingError(
                "a trajectory holds either an angle or a rate; give theta or theta_dot"
            )
        digest = hashlib.sha256()
        for name in ("time", "theta", "theta_dot", "x_ddot"):
            if (given := getattr(self, name)) is None:
                continue
            values = np.array(given, dtype=np.float64)
            if values.shape != (len(self.time),):
                raise RecordingError(
                    f"{name} has shape {values.shape}, expected {(len(self.time),)}: "
                    "give one value per time stamp"
                )
            if not np.all(np.isfinite(values)):
                raise RecordingError(
                    f"sample {_first(~np.isfinite(values))} of {name} is not a finite number; "
                    "remove it from the recording"
                )
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
        """What was recorded: the angle [rad], or the rate [rad/s]; shape (n,)."""
        recorded = self.theta if self.theta is not None else self.theta_dot
        return np.empty(0) if recorded is None else recorded


def read_swing(
    path: Path,
    *,
    counts_per_rev: int | None = None,
    from_upright: bool = False,
    start: float | None = None,
    end: float | None = None,
) -> Trajectory:
    """Read a recorded swing from a CSV file.

    Args:
        path: The file.
        counts_per_rev: Encoder counts per revolution (after x4); needed for a column `counts`.
        from_upright: The file's angle is phi, zero when upright, instead of theta.
        start: Take the recording from this time on [s], and take its word that the pendulum swings
            freely from there.
        end: Take the recording up to this time [s].

    Returns:
        The swing, as an angle from hanging or its rate.

    Raises:
        RecordingError: The file is missing, has other columns, holds something that is not a
            finite number, its time does not increase, or nothing is left of it.
    """
    data = _bytes(path)
    stamps, recorded, lines, quantity = _columns(path, data)
    if quantity == "counts" and not (counts_per_rev and counts_per_rev > 0):
        raise RecordingError(
            f"{path} holds encoder counts, but the counts per revolution are "
            f"{'not given' if counts_per_rev is None else counts_per_rev}; "
            "give them (after x4) with --counts-per-rev"
        )
    late = np.flatnonzero(np.diff(stamps) <= 0.0)
    if late.size:
        i = int(late[0]) + 1
        raise RecordingError(
            f"{path}, line {lines[i]}: time does not increase, {stamps[i]:.10g} s comes after "
            f"{stamps[i - 1]:.10g} s; remove repeated samples or sort the recording"
        )
    values, unit = recorded, 1.0
    if quantity == "theta_deg":
        unit = math.pi / 180.0
    elif quantity == "counts" and counts_per_rev:
        unit = 2.0 * math.pi / counts_per_rev
    resolution = unit if quantity == "counts" else unit * _step(recorded)
    values = unit * recorded
    is_rate = quantity == "rate_rad_s"
    if from_upright:
        values = -values if is_rate else math.pi - values
    keep = slice(
        0 if start is None else int(np.searchsorted(stamps, start - 1e-9)),
        len(stamps) if end is None else int(np.searchsorted(stamps, end + 1e-9)),
    )
    time, values = stamps[keep], values[keep]
    if time.size < 2:
        raise RecordingError(
            f"{path} has {time.size} samples between {start if start is not None else 'its start'} "
            f"and {end if end is not None else 'its end'}; it lasts from {stamps[0]:.10g} s to "
            f"{stamps[-1]:.10g} s: choose --start and --end inside"
        )
    if not is_rate:
        values = np.unwrap(values)
        values = values - 2.0 * math.pi * np.round(np.median(values) / (2.0 * math.pi))
    return Trajectory(
        time=time,
        theta=None if is_rate else values,
        theta_dot=values if is_rate else None,
        resolution=resolution,
        source=printable(path.name),
        sha256=DIGEST_PREFIX + hashlib.sha256(data).hexdigest(),
        released=start is not None,
    )


def write_swing(path: Path, trajectory: Trajectory) -> None:
    """Write a swing as a CSV file that `read_swing` reads back to the last bit.

    Raises:
        OutsideError: The disk refuses.
    """
    quantity = "theta_rad" if trajectory.theta is not None else "rate_rad_s"
    rows = zip(trajectory.time.tolist(), trajectory.values.tolist(), strict=True)
    write_whole(path, f"{TIME},{quantity}\n" + "".join(f"{t!r},{value!r}\n" for t, value in rows))


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise RecordingError(f"there is no file {path}; check the path") from None
    except OSError as error:
        raise RecordingError(
            f"cannot read {path}: {error.strerror}; give a CSV file that can be read"
        ) from None


def _columns(
    path: Path, data: bytes
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], list[int], str]:
    """Return time stamps, recorded values, the line of each, and the name of the quantity."""
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""))
        header = [name.strip() for name in next(reader, [])]
        found = [name for name in header if name in QUANTITIES]
        if TIME not in header or len(found) != 1:
            raise RecordingError(
                f"{path} has the columns {', '.join(header)[:80] or '(none)'}; expected {TIME} and "
                f"one of {', '.join(QUANTITIES)}: rename the columns in its first line"
            )
        cells, lines = [], []
        for row in reader:
            if any(cell.strip() for cell in row):
                cells.append(row)
                lines.append(reader.line_num)
    except (UnicodeDecodeError, csv.Error):
        raise RecordingError(
            f"{path} is not text; expected a CSV file with the columns {TIME} and one of "
            f"{', '.join(QUANTITIES)}"
        ) from None
    columns = [
        np.array(
            [_number(path, line, name, row, at) for row, line in zip(cells, lines, strict=True)]
        )
        for name, at in ((TIME, header.index(TIME)), (found[0], header.index(found[0])))
    ]
    if not lines:
        raise RecordingError(f"{path} holds no samples; record a swing of a few periods")
    return columns[0], columns[1], lines, found[0]


def _number(path: Path, line: int, name: str, row: list[str], at: int) -> float:
    cell = row[at].strip() if at < len(row) else ""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RecordingError(
            f"{path}, line {line}: {name} is {cell[:40]!r}, expected a finite number; "
            "correct or remove the line"
        )
    return value


def _step(values: npt.NDArray[np.float64]) -> float:
    """Return the smallest step between values that occur, ignoring rounding."""
    steps = np.diff(np.unique(values))
    scale = float(np.max(np.abs(values)))
    real = steps[steps > 1e-12 * scale]
    return float(real.min()) if real.size else 0.0


def _first(flags: npt.NDArray[np.bool_]) -> int:
    return int(np.flatnonzero(flags)[0])
