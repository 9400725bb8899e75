"""Poses of arm and pendulum at given times of a run.

The poses of a simulated run are its true states, from the release to the end. Those of a run on a
rig are its measurements, from the first tick until the arm is at rest. Times count from the
release; in a run on a rig that ended before it, from the first tick.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.style import typeset
from equipoise.errors import ArmError, ArtefactError, InputError, RecordingError
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm

Floats = npt.NDArray[np.float64]

LEAD: Final = 2.0
"""Time shown before the release of a run on a rig [s]."""


class Moments(NamedTuple):
    """Poses and captions of a sequence of pictures."""

    time: Floats
    """Time since the origin [s], shape (n,)."""
    x: Floats
    """Displacement of the flange [m], shape (n,)."""
    phi: Floats
    """Angle of the pendulum from upright [rad], shape (n,); NaN while unknown."""
    q: Floats
    """All joints [rad], shape (n, joints)."""
    u: Floats
    """Commanded acceleration of the flange [m/s^2], shape (n,); zero while no policy runs."""
    phase: tuple[str, ...] = ()
    """Phase of each picture; empty where the policy ran all the time."""

    def captions(self) -> list[tuple[str, str, str, str]]:
        """Return formatted time, displacement, angle and command of each picture."""
        time = [typeset(f"t = {t:.2f} s") for t in self.time]
        x = [f"x = {signed(x, 3)} m" for x in self.x]
        phi = [
            f"φ = {signed(degrees, 1)}°" if np.isfinite(degrees) else "φ unknown"
            for degrees in np.rad2deg(self.phi)
        ]
        u = [f"u = {signed(u, 1)} m/s²" for u in self.u]
        return list(zip(time, x, phi, u, strict=True))


def origin(run: RunLog) -> float:
    """Return the time from which pictures count, on the run's clock [s].

    It is the release; in a run on a rig that ended before it, the first tick.

    Raises:
        RecordingError: No policy ran, or a run on a rig ended before its first tick.
    """
    if run.conditions.simulated or len(run.ticks):
        run.require_balancing()
        return run.release
    if not len(run.tables["tick"]):
        reason = f" ({run.end.reason})" if run.end else ""
        raise RecordingError(
            f"the run ended before its first tick{reason}, there is nothing to show; give another"
        )
    return float(run.tables["tick"]["time"][0])


def whole_span(run: RunLog) -> tuple[float, float]:
    """Return start and end of a run, since the origin [s]; raise as `origin` does."""
    began = origin(run)
    if run.conditions.simulated:
        return 0.0, run.lasted
    time = run.tables["tick"]["time"] - began
    return float(time[0]), float(time[-1])


def span(run: RunLog) -> tuple[float, float]:
    """Return start and end of the usual part of a run, since the origin [s].

    A run on a rig is shown from shortly before the release; raises as `origin` does.
    """
    begin, end = whole_span(run)
    return max(begin, -LEAD), end


def check_span(run: RunLog, begin: float | None, end: float | None) -> tuple[float, float]:
    """Return start and end of a part of a run, since the origin [s].

    Args:
        run: The run.
        begin: Start [s]; None for that of `span`.
        end: End [s]; None for that of `span`.

    Raises:
        InputError: The part is outside the run, or ends before its start.
        RecordingError: As `origin` does.
    """
    (first, last), usual = whole_span(run), span(run)
    begin, end = usual[0] if begin is None else begin, usual[1] if end is None else end
    if not first <= begin <= end <= last:
        raise InputError(
            f"the part from {begin:g} to {end:g} s is not one of the run, which is known from "
            f"{first:.2f} to {last:.2f} s; give a start and a later end in it"
        )
    return begin, end


def moments(run: RunLog, arm: Arm, times: Sequence[float] | Floats) -> Moments:
    """Return the poses at `times` since the origin [s], interpolated linearly between rows.

    Sources in order of preference: the true state, on a rig the measurements, else observation and
    commands. A command holds until the next tick.

    Raises:
        ArmError: The run is of another arm.
        RecordingError: No policy ran, or a run on a rig ended before its first tick.
    """
    at = np.asarray(times, np.float64)
    ran, conditions = run.conditions.arm, run.conditions
    if (ran.name, conditions.joints) != (arm.name, tuple(joint.name for joint in arm.joints)):
        raise ArmError(f"the run is one of {ran.name}, not of {arm.name}; give the arm that ran")
    began = origin(run)
    if not conditions.simulated:
        return _measured(run, arm, at, began)
    shown = run.truth if len(run.truth.q) else run
    x, phi, *q = (np.interp(at, run.time, v) for v in (shown.x, shown.phi, *shown.q.T))
    return Moments(at, x, phi, np.column_stack(q), run.u[_tick(run.time, at)])


def _measured(run: RunLog, arm: Arm, at: Floats, began: float) -> Moments:
    """Return the measurements of a rig; joint timestamps are midway between request and reply."""
    tick, reply = run.tables["tick"], run.tables["reply"]
    reply = reply[np.isfinite(reply["q"]).all(axis=1) & np.isfinite(reply["sent"])]
    joints = reply if len(reply) else tick[np.isfinite(tick["q"]).all(axis=1)]
    if not len(joints):
        raise RecordingError("the run has no posture of the arm, there is nothing to show")
    measured = 0.5 * (reply["sent"] + reply["time"]) if len(reply) else joints["time"]
    q = np.column_stack([np.interp(at, measured - began, joint) for joint in joints["q"].T])
    home = arm.pose(arm.home_free).position[0]
    x = [arm.pose(arm.without_held(row)).position[0] - home for row in q.tolist()]
    row = _tick(tick["time"] - began, at)
    phase = tuple(run.conditions.phases[state].value for state in tick["state"][row].tolist())
    phi = _measured_phi(run, at, began)
    return Moments(at, np.array(x), phi, q, np.nan_to_num(tick["u"][row]), phase)


def _measured_phi(run: RunLog, at: Floats, began: float) -> Floats:
    """Return the angle by the encoder; NaN if no count, or no zero is known."""
    encoder, unknown = run.tables["encoder"], np.full(len(at), np.nan)
    try:
        zero = run.encoder_zero
    except ArtefactError:  # the run ended before its zero was found
        return unknown
    if not len(encoder):
        return unknown
    counts = np.interp(at, encoder["time"] - began, encoder["counts"])
    turns = (counts - zero) / (run.conditions.counts_per_rev or 1)
    return np.remainder(-2.0 * np.pi * turns, 2.0 * np.pi) - np.pi


def _tick(time: Floats, at: Floats) -> npt.NDArray[np.intp]:
    """Return the row of the tick that contains each time."""
    return np.maximum(np.searchsorted(time, at, side="right") - 1, 0)


def signed(value: float, digits: int) -> str:
    """Format a number with its sign; a value that rounds to zero has no sign."""
    text = f"{value:+.{digits}f}"
    return typeset(text) if float(text) else text[1:]
