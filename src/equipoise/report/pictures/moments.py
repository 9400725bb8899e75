"""Poses of arm and pendulum at given times of a run.

The poses of a simulated run are its true states, from the release to the end. Those of a run on a
rig are its measurements, from shortly before the release until the arm is at rest.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import ArmError
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.report.style import typeset

Floats = npt.NDArray[np.float64]

LEAD: Final = 2.0
"""Time shown before the release of a run on a rig [s]."""


class Moments(NamedTuple):
    """Poses and captions of a sequence of pictures."""

    time: Floats
    """Time since the release [s], shape (n,)."""
    x: Floats
    """Displacement of the flange [m], shape (n,)."""
    phi: Floats
    """Angle of the pendulum from upright [rad], shape (n,)."""
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
        phi = [f"φ = {signed(degrees, 1)}°" for degrees in np.rad2deg(self.phi)]
        u = [f"u = {signed(u, 1)} m/s²" for u in self.u]
        return list(zip(time, x, phi, u, strict=True))


def span(run: RunLog) -> tuple[float, float]:
    """Return start and end of the shown part of a run, since the release [s].

    Raises:
        RecordingError: A run on a rig ended before balancing.
    """
    if run.conditions.simulated:
        return 0.0, run.lasted
    time = run.tables["tick"]["time"] - run.release
    return max(float(time[0]), -LEAD), float(time[-1])


def moments(run: RunLog, arm: Arm, times: Sequence[float] | Floats) -> Moments:
    """Return the poses at `times` since the release [s], interpolated linearly between rows.

    Sources in order of preference: the true state, on a rig the measurements, else observation and
    commands. A command holds until the next tick.

    Raises:
        ArmError: The run is of another arm.
        RecordingError: No policy ran, or a run on a rig ended before balancing.
    """
    at = np.asarray(times, np.float64)
    ran, conditions = run.conditions.arm, run.conditions
    if (ran.name, conditions.joints) != (arm.name, tuple(joint.name for joint in arm.joints)):
        raise ArmError(f"the run is one of {ran.name}, not of {arm.name}; give the arm that ran")
    run.require_balancing()
    if not conditions.simulated:
        return _measured(run, arm, at)
    shown = run.truth if len(run.truth.q) else run
    x, phi, *q = (np.interp(at, run.time, v) for v in (shown.x, shown.phi, *shown.q.T))
    return Moments(at, x, phi, np.column_stack(q), run.u[_tick(run.time, at)])


def _measured(run: RunLog, arm: Arm, at: Floats) -> Moments:
    """Return the measurements of a rig; joint timestamps are midway between request and reply."""
    tick, encoder, reply = (run.tables[name] for name in ("tick", "encoder", "reply"))
    reply = reply[np.isfinite(reply["q"]).all(axis=1) & np.isfinite(reply["sent"])]
    measured = 0.5 * (reply["sent"] + reply["time"]) - run.release
    q = np.column_stack([np.interp(at, measured, joint) for joint in reply["q"].T])
    home = arm.pose(arm.home_free).position[0]
    x = [arm.pose(arm.without_held(row)).position[0] - home for row in q.tolist()]
    counts = np.interp(at, encoder["time"] - run.release, encoder["counts"])
    turns = (counts - run.encoder_zero) / (run.conditions.counts_per_rev or 1)
    phi = np.remainder(-2.0 * np.pi * turns, 2.0 * np.pi) - np.pi
    row = _tick(tick["time"] - run.release, at)
    phase = tuple(run.conditions.phases[state].value for state in tick["state"][row].tolist())
    return Moments(at, np.array(x), phi, q, np.nan_to_num(tick["u"][row]), phase)


def _tick(time: Floats, at: Floats) -> npt.NDArray[np.intp]:
    """Return the row of the tick that contains each time."""
    return np.maximum(np.searchsorted(time, at, side="right") - 1, 0)


def signed(value: float, digits: int) -> str:
    """Format a number with its sign; a value that rounds to zero has no sign."""
    text = f"{value:+.{digits}f}"
    return typeset(text) if float(text) else text[1:]
