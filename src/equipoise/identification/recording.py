"""Recorded motions of the pendulum, and their CSV files.

theta is measured from hanging, in radians, and increases with the encoder's counts; theta + phi =
pi. A recording holds theta, or its rate from a gyro. The file has a header and one sample per
line::

    time_s,theta_rad        or time_ms, time_us; theta_deg, counts, rate_rad_s
    0.000,-1.618429

Semicolons and tabs are accepted separators, also with decimal commas. Text is UTF-8. Other columns,
and rows that repeat the one before, are ignored. Angles are unwrapped: a jump by more than half a
turn between two samples comes from a recorder that wraps the angle. Counts are unwrapped by the
period of their counter, and times by that of one of 32 bits.
"""

import csv
import hashlib
import io
from array import array
from dataclasses import dataclass
from math import inf, pi
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from equipoise.arguments import Duration, checked
from equipoise.arrays import Array
from equipoise.errors import RecordingError
from equipoise.files import (
    DIGEST_PREFIX,
    MEBIBYTE,
    Seed,
    StrPath,
    decode_text,
    read_bytes,
    shortened,
    write_atomically,
)
from equipoise.model.encoder import counts_from_theta, theta_from_counts
from equipoise.model.pendulum import STEPS_PER_PERIOD, Pendulum, PendulumParameters, swing
from equipoise.printable import printable
from equipoise.settings import MAX_COUNTS_PER_REV

TIMES: Final = {"time_s": 1.0, "time_ms": 1e-3, "time_us": 1e-6}
"""Accepted columns of time stamps, with their units [s]; a file has one."""
QUANTITIES: Final = ("theta_rad", "theta_deg", "counts", "rate_rad_s")
"""Accepted columns of the motion; a file has one."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion of the pendulum over time, with read-only arrays."""

    time: Array
    """Time stamps [s], increasing, shape (n,)."""
    theta: Array | None = None
    """Angle from hanging [rad], shape (n,); None if a gyro recorded the rate."""
    theta_dot: Array | None = None
    """Rate of the angle [rad/s], shape (n,); None if the angle was recorded."""
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
        for name in ("time", "theta", "theta_dot"):
            if getattr(self, name) is None:
                continue
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (len(self.time),) or not np.all(np.isfinite(values)):
                raise RecordingError(
                    f"{self.source}: {name} has the shape {values.shape}, or values that are not "
                    "finite; give one finite value per time stamp"
                )
            digest.update(name.encode() + values.tobytes())
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        late = np.flatnonzero(np.diff(self.time) <= 0.0)
        if late.size:
            raise RecordingError(
                f"{self.source}: {late.size} of {len(self.time)} time stamps do not increase, the "
                f"first after {self.time[late[0]]:.10g} s; record times with more digits, or sort "
                "the samples"
            )
        if not self.sha256:
            object.__setattr__(self, "sha256", DIGEST_PREFIX + digest.hexdigest())

    @property
    def values(self) -> Array:
        """Recorded values: the angle [rad], or the rate [rad/s]; shape (n,)."""
        recorded = self.theta if self.theta is not None else self.theta_dot
        return np.empty(0) if recorded is None else recorded


@checked
def read_swing(
    path: StrPath,
    *,
    counts_per_rev: int | None = None,
    from_upright: bool = False,
    start: float | None = None,
    end: float | None = None,
) -> Trajectory:
    """Read a recorded swing from a CSV file.

    Args:
        path: The file.
        counts_per_rev: Encoder counts per revolution (after x4); required for a column `counts`.
        from_upright: The angle in the file is phi, zero when upright, instead of theta.
        start: Begin of the used part [s]; the pendulum is assumed to swing freely from there.
        end: End of the used part [s].

    Returns:
        The swing, as an angle from hanging or its rate.

    Raises:
        RecordingError: The file is missing or too large, has other columns, holds a value that is
            not a finite number, its time does not increase, or no samples are left.
    """
    path = Path(path)
    data = read_bytes(path, 128 * MEBIBYTE, "a recording", RecordingError)
    time_name, quantity, table = _read_table(path, data)
    is_counts, is_rate = quantity == "counts", quantity == "rate_rad_s"
    if is_counts and (counts_per_rev is None or counts_per_rev <= 0):
        raise RecordingError(
            f"{path} holds encoder counts, but the counts per revolution are {counts_per_rev}; "
            "give them (after x4) with --counts-per-rev"
        )
    turn = {"theta_deg": 360.0, "counts": counts_per_rev or 1}.get(quantity, 2.0 * pi)
    unit = 2.0 * pi / turn
    stamps, values = table[np.append(True, np.any(np.diff(table, axis=0), axis=1))].T
    resolution = unit * (1.0 if is_counts else _smallest_step(values))
    # The clock of a microcontroller wraps after 71.6 minutes of microseconds.
    stamps = TIMES[time_name] * np.unwrap(stamps, period=2.0**32)
    if not is_rate:
        values = np.unwrap(values, period=_wrap(values, turn) if is_counts else turn)
    keep = stamps >= (-inf if start is None else start - 1e-9)
    keep &= stamps < (inf if end is None else end + 1e-9)
    if np.count_nonzero(keep) < 2:
        raise RecordingError(
            f"{path} has {np.count_nonzero(keep)} samples between {start} and {end} s, it lasts "
            f"from {stamps[0]:.10g} s to {stamps[-1]:.10g} s; choose --start and --end inside"
        )
    values = unit * values[keep]
    if from_upright:
        values = -values if is_rate else pi - values
    if not is_rate:
        values -= 2.0 * pi * np.round(np.median(values) / (2.0 * pi))
    return Trajectory(
        time=stamps[keep],
        theta=None if is_rate else values,
        theta_dot=values if is_rate else None,
        resolution=resolution,
        source=printable(path.name),
        sha256=DIGEST_PREFIX + hashlib.sha256(data).hexdigest(),
        released=start is not None,
    )


def _wrap(counts: Array, turn: float) -> float:
    """Return the period by which counts wrap: that of a counter that overflows, or a turn.

    A swing that is sampled ten times a period never moves by half of its range between two samples.
    A larger step is a wrap, less the motion meanwhile, and its period exceeds the range.
    """
    steps, span = np.diff(counts), float(np.ptp(counts))
    wraps = np.abs(steps) > 0.5 * span
    if not np.any(wraps):
        return turn
    motion = np.where(wraps, 0.0, steps)
    between = np.convolve(motion, (0.5, 0.0, 0.5))[1:-1]
    period = float(np.median(np.abs(steps - between)[wraps]))
    powers = turn, 2.0 ** np.round(np.log2(period))
    known = min(powers, key=lambda wrap: abs(wrap - period))
    if abs(known - period) <= 1.0 + np.max(np.abs(motion)):
        period = known
    return max(float(np.round(period)), span + 1.0) if period > span else turn


def _read_table(path: Path, data: bytes) -> tuple[str, str, Array]:
    """Return the names of the columns of time and motion, and their numbers, shape (n, 2)."""
    text = decode_text(data, path, "a recording", RecordingError)
    first, _, text = io.StringIO(text, newline=None).read().partition("\n")
    separator = max(",;\t", key=first.count) if ";" in first or "\t" in first else ","
    if separator != ",":
        text, first = text.replace(",", "."), first.replace(",", ".")
    names = [cell.strip().strip('"') for cell in first.split(separator)]
    chosen = [next((name for name in names if name in kinds), "") for kinds in (TIMES, QUANTITIES)]
    known = [name for name in names if name in TIMES or name in QUANTITIES]
    if "" in chosen or len(known) != 2:
        raise RecordingError(
            f"{path} has the columns {shortened(', '.join(names), 80)!r}, expected one of "
            f"{', '.join(TIMES)} and one of {', '.join(QUANTITIES)}, separated by a comma, a "
            "semicolon or a tab; name the columns in the first line"
        )
    places, table = [names.index(name) for name in chosen], array("d")
    limits = 1e10 / TIMES[chosen[0]], 1e10  # 300 years; an angle or a rate beyond any encoder's
    rows = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=True)
    try:
        for row in rows:
            if any(map(str.strip, row)):
                if not max(places) < len(row) <= len(names) + 1:
                    raise ValueError(f"{len(row)} cells, expected {len(names)}")
                numbers = [float(row[place]) for place in places]
                if not all(
                    abs(number) <= limit for number, limit in zip(numbers, limits, strict=True)
                ):
                    raise ValueError(f"{numbers} are not finite, or too large for their units")
                table.extend(numbers)
    except (ValueError, csv.Error) as error:
        raise RecordingError(
            f"{path}: line {rows.line_num + 1}: {shortened(str(error), 200)}; expected finite "
            "numbers such as -1.25 or 3e-4: correct or remove the line, and separate columns by "
            "semicolons where decimals have commas"
        ) from None
    if not table:
        raise RecordingError(f"{path} holds no samples; record a swing of a few periods")
    return chosen[0], chosen[1], np.array(table).reshape(-1, 2)


def _smallest_step(values: Array) -> float:
    """Return the smallest step between distinct values, ignoring rounding."""
    steps = np.diff(np.unique(values))
    real = steps[steps > 1e-12 * np.max(np.abs(values))]
    return float(real.min()) if real.size else 0.0


@checked
def write_swing(path: StrPath, trajectory: Trajectory) -> None:
    """Write a swing as a CSV file, without loss of precision.

    Raises:
        OutsideError: The disk rejects the file.
    """
    quantity = "theta_rad" if trajectory.theta is not None else "rate_rad_s"
    rows = zip(trajectory.time.tolist(), trajectory.values.tolist(), strict=True)
    text = "".join(f"{t!r},{value!r}\n" for t, value in rows)
    write_atomically(Path(path), f"time_s,{quantity}\n{text}")


@checked
def simulate_swing(
    parameters: PendulumParameters,
    *,
    theta0: float,
    duration: Duration,
    rate_hz: Annotated[float, Field(gt=0.0, le=1e5)],
    counts_per_rev: Annotated[int, Field(ge=4, le=MAX_COUNTS_PER_REV)],
    noise: Annotated[float, Field(ge=0.0)] = 0.0,
    zero_offset: float = 0.0,
    seed: Seed = 0,
) -> Trajectory:
    """Simulate the recording of a free swing, released at rest, by an encoder.

    Args:
        parameters: The pendulum.
        theta0: Angle from hanging at the release [rad].
        duration: Duration of the recording [s].
        rate_hz: Sampling rate [Hz].
        counts_per_rev: Encoder counts per revolution.
        noise: Standard deviation of white noise on the angle before quantization [rad].
        zero_offset: Encoder angle of the hanging pendulum [rad].
        seed: Seed of the noise.

    Returns:
        The recording, without a known release.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * rate_hz) + 1) / rate_hz
    # Eight times as many steps as in a fit, so that a test of one does not share its error.
    h = 2.0 * pi / np.sqrt(parameters.w2) / 1024
    theta, _ = swing(time, theta0, 0.0, float(h), parameters)
    reading = theta + zero_offset + noise * rng.standard_normal(time.size)
    counts = counts_from_theta(reading, counts_per_rev, 1)
    return Trajectory(
        time=time,
        theta=theta_from_counts(counts, counts_per_rev, 1),
        resolution=2.0 * pi / counts_per_rev,
        source="simulated swing",
    )


def fitted_curve(trajectory: Trajectory, pendulum: Pendulum) -> Array:
    """Return the fitted sensor values at the times of a recording.

    Args:
        trajectory: The recording that `pendulum` was identified from.
        pendulum: The pendulum, with its fit.

    Returns:
        Angle [rad] or rate [rad/s] with zero offset or bias, shape (n,); NaN outside the fitted
        window.

    Raises:
        RecordingError: The pendulum was not identified from this recording.
    """
    fit = pendulum.fit
    if fit is None or fit.sha256 != trajectory.sha256:
        raise RecordingError(
            f"the pendulum was identified from {fit.source if fit else 'no recording'}, "
            f"not from this {trajectory.source}; give the recording that it came from"
        )
    begin, end = fit.window
    inside = (trajectory.time >= begin - 1e-9) & (trajectory.time <= end + 1e-9)
    # The fitted state is that of the window's start, which may lie between two samples.
    time = np.concatenate(([begin], trajectory.time[inside]))
    h = (end - begin) / fit.periods / STEPS_PER_PERIOD
    theta, theta_dot = swing(time, fit.theta, fit.theta_dot, h, pendulum.parameters())
    curve = np.full(trajectory.time.shape, np.nan)
    curve[inside] = (theta_dot if fit.quantity == "rate" else theta)[1:] + fit.offset
    return curve
