"""Where arm and pendulum were at chosen moments of a run.

Of a run on model or twin that is the truth, from the release to the end. Of a run on a rig it is
what was measured, from shortly before the release until the arm rests.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import ArmError, ArtefactError
from equipoise.model.arms.arm import Arm
from equipoise.runlog import RunLog
from equipoise.runwriter import RigRun
from equipoise.studies.runs import balancing_ticks, encoder_zero

Floats = npt.NDArray[np.float64]

LEAD: Final = 2.0
"""Of a run on a rig so much is shown of the hold before the release [s]."""


class Moments(NamedTuple):
    """What a picture shows and what is written beside it."""

    time: Floats
    """Since the release [s], shape (n,)."""
    x: Floats
    """Displacement of the flange [m], shape (n,)."""
    phi: Floats
    """Angle of the pendulum from upright [rad], shape (n,)."""
    q: Floats
    """All joints [rad], shape (n, joints)."""
    u: Floats
    """Commanded acceleration of the flange [m/s^2], shape (n,); zero while no policy runs."""
    phase: tuple[str, ...] = ()
    """What went on, in a word each; empty where the policy ran all the time."""

    def captions(self) -> list[tuple[str, str, str, str]]:
        """Return time, displacement, angle and command of each, in words."""
        return [
            (
                f"t = {time:.2f} s".replace("-", MINUS),
                f"x = {signed(x, 3)} m",
                f"φ = {signed(phi_deg, 1)}°",
                f"u = {signed(u, 1)} m/s²",
            )
            for time, x, phi_deg, u in zip(
                self.time, self.x, np.rad2deg(self.phi), self.u, strict=True
            )
        ]


def span(run: RunLog | RigRun) -> tuple[float, float]:
    """Return when what is shown of a run begins and ends, since the release [s].

    Raises:
        RecordingError: A run on a rig did not get as far as balancing.
    """
    if isinstance(run, RunLog):
        return 0.0, run.lasted
    time = run.tables["tick"]["time"]
    released = float(time[balancing_ticks(run)[0]])
    return max(float(time[0]) - released, -LEAD), float(time[-1]) - released


def moments(run: RunLog | RigRun, arm: Arm, times: Sequence[float] | Floats) -> Moments:
    """Return the run at `times` since the release [s], from straight lines between its rows.

    The truth is shown where it is known; of a rig what it measured; else what the policy saw and
    commanded. A command stands until the next tick.

    Raises:
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
        RecordingError: A run on a rig did not get as far as balancing.
    """
    at = np.asarray(times, np.float64)
    names = tuple(joint.name for joint in arm.joints)
    ran, joints = (
        (run.conditions["arm"], tuple(run.conditions["joint_names"]))
        if isinstance(run, RigRun)
        else (run.conditions.arm, run.conditions.joints)
    )
    if (ran, joints) != (arm.name, names):
        raise ArmError(f"the run is one of {ran}, not of {arm.name}; give the arm that ran")
    if isinstance(run, RigRun):
        return _measured(run, arm, at)
    if not len(run.time):
        raise ArtefactError("the run has no ticks, nothing to show; give one in which a policy ran")
    shown = run.truth if len(run.truth.q) else run
    x, phi, *q = (np.interp(at, run.time, v) for v in (shown.x, shown.phi, *shown.q.T))
    return Moments(at, x, phi, np.column_stack(q), run.u[_tick(run.time, at)])


def _measured(run: RigRun, arm: Arm, at: Floats) -> Moments:
    """Return what a rig measured; joints where they were half-way between asking and answer."""
    tick, encoder, reply = (run.tables[name] for name in ("tick", "encoder", "reply"))
    released = float(tick["time"][balancing_ticks(run)[0]])
    reply = reply[np.isfinite(reply["q"]).all(axis=1) & np.isfinite(reply["sent"])]
    told = 0.5 * (reply["sent"] + reply["time"]) - released
    q = np.column_stack([np.interp(at, told, joint) for joint in reply["q"].T])
    home = arm.pose(arm.home_free).position[0]
    x = [arm.pose(arm.without_held(row)).position[0] - home for row in q.tolist()]
    counts = np.interp(at, encoder["time"] - released, encoder["counts"])
    turns = (counts - encoder_zero(run)) / int(run.conditions["rig"]["counts_per_rev"])
    phi = np.remainder(-2.0 * np.pi * turns, 2.0 * np.pi) - np.pi
    names = run.conditions["phases"]
    row = _tick(tick["time"] - released, at)
    phase = tuple(names[state] for state in tick["state"][row].tolist())
    return Moments(at, np.array(x), phi, q, np.nan_to_num(tick["u"][row]), phase)


def _tick(time: Floats, at: Floats) -> npt.NDArray[np.intp]:
    """Return the row of the tick in which each moment lies."""
    return np.maximum(np.searchsorted(time, at, side="right") - 1, 0)


MINUS: Final = "\N{MINUS SIGN}"


def signed(value: float, digits: int) -> str:
    """Return a number as it is printed, with its sign, unless it is zero."""
    text = f"{value:+.{digits}f}"
    return text.replace("-", MINUS) if float(text) else text[1:]
