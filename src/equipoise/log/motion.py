"""Motion of arm and pendulum in a run, for films and replays.

The poses of a simulated run are its true states, those of a run on a rig its measurements. Times
count from the release; in a run that ended before it, from the first tick.
"""

from math import pi
from typing import NamedTuple, Self

import numpy as np

from equipoise.arrays import Array
from equipoise.errors import ArtefactError, InputError, RecordingError
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Phase


class Pose(NamedTuple):
    """State of a run at a time."""

    q: Array
    """Measured joints [rad], in simulation the true ones, shape (joints,)."""
    x: float
    """Displacement of the flange [m]."""
    phi: float
    """Angle of the pendulum from upright [rad], from -pi to pi; NaN while unknown."""
    u: float
    """Commanded acceleration of the flange [m/s^2]; 0 while no policy acts."""
    late: float
    """Lateness of the tick [s]; NaN in simulation."""
    phase: str
    """Phase of the run."""


class Motion(NamedTuple):
    """Motion of a run at its ticks."""

    time: Array
    """Times of the ticks [s], increasing, shape (n,)."""
    q: Array
    """Joints [rad], as of `Pose`, shape (n, joints)."""
    x: Array
    """Displacement of the flange [m], shape (n,)."""
    phi: Array
    """Angle from upright [rad], continuous beyond a turn, shape (n,); NaN while unknown."""
    u: Array
    """Commanded acceleration [m/s^2], shape (n,)."""
    late: Array
    """Lateness [s], shape (n,); NaN in simulation."""
    phases: tuple[str, ...]
    """Phase of each tick."""
    end: float
    """End of the motion [s]."""
    began: float
    """Time zero on the run's clock [s]."""

    @classmethod
    def of(cls, run: RunLog) -> Self:
        """Return the motion of a run.

        Raises:
            RecordingError: No policy ran, a run on a rig ended before its first tick, or the times
                of the ticks do not increase.
        """
        conditions, tick = run.conditions, run.tables["tick"]
        if not len(tick):
            raise RecordingError("the run ended before its first tick, there is nothing to show")
        began = run.release if len(run.ticks) else float(tick["time"][0])
        time = np.asarray(tick["time"] - began, np.float64)
        if not (np.isfinite(time).all() and np.all(np.diff(time) > 0.0)):
            raise RecordingError(
                "the times of the ticks in the log do not increase; give the log as it was written"
            )
        if conditions.simulated:
            true = run.tables["truth"]
            q, x, phi, late = true["q"], true["x"], true["phi"], np.full(len(time), np.nan)
        else:
            q = _measured_joints(run, time + began)
            arm = conditions.arm
            poses = [arm.kinematics(arm.without_held(row)) for row in q.tolist()]
            home = arm.kinematics(arm.home_free).position[0]
            x = np.array([pose.position[0] for pose in poses]) - home
            phi, late = _measured_phi(run, time + began), tick["late"]
        phases = tuple(conditions.phases[state].value for state in tick["state"].tolist())
        phi = np.unwrap(phi)
        if np.isfinite(phi).all():  # upright at the release is zero
            phi -= 2.0 * pi * np.round(phi[int(np.searchsorted(time, 0.0))] / (2.0 * pi))
        u = np.nan_to_num(tick["u"])
        return cls(time, q, x, phi, u, late, phases, float(time[-1]) + conditions.h, began)

    def part(self, begin: float | None = None, end: float | None = None) -> tuple[float, float]:
        """Return start and end of a part [s].

        Args:
            begin: Start [s]; by default shortly before the swing-up, or else the release.
            end: End [s]; by default that of the motion.

        Raises:
            InputError: The part is outside the run, or ends before its start.
        """
        first = float(self.time[0])
        acts = [phase in (Phase.SWINGING_UP.value, Phase.BALANCING.value) for phase in self.phases]
        begin = max(first, float(self.time[np.argmax(acts)]) - 2.0) if begin is None else begin
        end = self.end if end is None else end
        if not first <= begin <= end <= self.end:
            raise InputError(
                f"the part from {begin:g} to {end:g} s is outside the run, which is known from "
                f"{first:.2f} to {self.end:.2f} s; give a start and a later end in it"
            )
        return begin, end

    def at(self, time: float) -> Pose:
        """Return the state at a time [s]; between ticks, poses lie on straight lines."""
        row = max(int(np.searchsorted(self.time, time + 1e-9, side="right")) - 1, 0)
        columns = (*self.q.T, self.x, self.phi)
        *q, x, phi = (float(np.interp(time, self.time, column)) for column in columns)
        phi = float(np.remainder(phi + pi, 2.0 * pi) - pi)
        late = float(self.late[row])
        return Pose(np.array(q), x, phi, float(self.u[row]), late, self.phases[row])


def _measured_joints(run: RunLog, at: Array) -> Array:
    """Return the measured joints at some times on the run's clock [s], shape (n, joints)."""
    reply = run.tables["reply"]
    reply = reply[np.isfinite(reply["q"]).all(axis=1) & np.isfinite(reply["sent"])]
    if not len(reply):
        raise RecordingError("the run has no posture of the arm, there is nothing to show")
    # Joints are measured midway between request and reply.
    measured = 0.5 * (reply["sent"] + reply["time"])
    return np.column_stack([np.interp(at, measured, joint) for joint in reply["q"].T])


def _measured_phi(run: RunLog, at: Array) -> Array:
    """Return the angle by the encoder; NaN without counts, or before a zero was found."""
    encoder = run.tables["encoder"]
    try:
        counts = np.interp(at, encoder["time"], encoder["counts"]) - run.encoder_zero
    except (ArtefactError, ValueError):
        return np.full(len(at), np.nan)
    turns = counts / (run.conditions.counts_per_rev or 1)
    return np.remainder(-2.0 * pi * turns, 2.0 * pi) - pi
