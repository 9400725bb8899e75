"""A run log for the replay: its state at any time, and the events to jump to.

Times count from the release; in a run on a rig that ended before it, from the first tick. Poses are
those of the pictures: true states of a simulated run, measurements of
a rig.
"""

from math import isfinite, pi
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.pictures import moments, origin, span, whole_span
from equipoise.errors import RecordingError
from equipoise.logs.run_log import RunLog
from equipoise.rig.explanation import explain

Floats = npt.NDArray[np.float64]

FAULTS: Final = ("warning", "fault", "failed")
"""Names of logged events that the replay shows beside phases and causes."""
MAX_MARKS: Final = 60
"""Maximum number of events; causes come first."""
SAME_TIME: Final = 0.05
"""Largest distance of a logged sentence from the change of the phase that it is about [s]."""


class Mark(NamedTuple):
    """An event to jump to."""

    time: float
    """Time [s]."""
    name: str
    """What happened, in a word or two."""
    text: str = ""
    """What happened, in a sentence."""
    cause: bool = False
    """Whether it is a cause of the end, as `equipoise log explain` names it."""


class RunPose(NamedTuple):
    """State of a run at a time."""

    q: Floats
    """Measured joints [rad], in simulation the true ones, shape (joints,)."""
    commanded: Floats
    """Commanded joints [rad], shape (joints,)."""
    phi: float
    """Angle of the pendulum from upright [rad], from -pi to pi; NaN while unknown."""
    x: float
    """Displacement of the flange [m]."""
    u: float
    """Commanded acceleration of the flange [m/s^2]; 0 while no policy acts."""
    late: float
    """Lateness of the tick [s]; NaN in simulation."""
    phase: str
    """Phase of a run on a rig; empty in simulation."""


class ReplayedRun(NamedTuple):
    """A run at its ticks."""

    time: Floats
    """Times of the ticks [s], increasing, shape (n,)."""
    q: Floats
    """Joints [rad], as of `RunPose`, shape (n, joints)."""
    commanded: Floats
    """Joints commanded for the end of the tick [rad], shape (n, joints)."""
    phi: Floats
    """Angle from upright [rad], continuous beyond a turn, shape (n,); NaN while unknown."""
    x: Floats
    """Displacement of the flange [m], shape (n,)."""
    u: Floats
    """Commanded acceleration [m/s^2], shape (n,)."""
    late: Floats
    """Lateness [s], shape (n,); NaN in simulation."""
    phases: tuple[str, ...]
    """Phase of each tick; empty in simulation."""
    h: float
    """Time between ticks [s]."""
    whole: tuple[float, float]
    """Start and end of the run [s]."""
    usual: tuple[float, float]
    """Start and end of the part that is shown first [s]."""
    marks: tuple[Mark, ...]
    """Events in the order of time."""

    @classmethod
    def of(cls, run: RunLog) -> Self:
        """Return a run for the replay.

        Raises:
            RecordingError: No policy ran, a run on a rig ended before its first tick, or the times
                of the ticks do not increase.
        """
        began, tick = origin(run), run.ticks if run.conditions.simulated else run.tables["tick"]
        time = np.asarray(tick["time"] - began, np.float64)
        if not (np.isfinite(time).all() and np.all(np.diff(time) > 0.0)):
            raise RecordingError(
                "the times of the ticks in the log do not increase; give the log as it was written"
            )
        shown = moments(run, run.conditions.arm, time)
        phi = np.unwrap(shown.phi)
        if len(phi) and np.isfinite(phi).all():
            phi -= 2.0 * pi * np.round(phi[max(int(np.searchsorted(time, 0.0)), 0)] / (2.0 * pi))
        return cls(
            time=time,
            q=shown.q,
            commanded=np.asarray(tick["q"], np.float64),
            phi=phi,
            x=shown.x,
            u=shown.u,
            late=np.full(len(time), np.nan) if run.conditions.simulated else tick["late"],
            phases=shown.phase,
            h=run.conditions.h,
            whole=whole_span(run),
            usual=span(run),
            marks=_marks(run, time, shown.phase, began),
        )

    def at(self, time: float) -> RunPose:
        """Return the state at a time [s]; between ticks, poses lie on straight lines."""
        row = max(int(np.searchsorted(self.time, time + 1e-9, side="right")) - 1, 0)
        phi = float(np.interp(time, self.time, self.phi))
        return RunPose(
            q=_between(time, self.time, self.q),
            commanded=_between(time, self.time + self.h, self.commanded),
            phi=float(np.remainder(phi + pi, 2.0 * pi) - pi) if isfinite(phi) else phi,
            x=float(np.interp(time, self.time, self.x)),
            u=float(self.u[row]),
            late=float(self.late[row]),
            phase=self.phases[row] if self.phases else "",
        )


def _between(time: float, times: Floats, rows: Floats) -> Floats:
    """Return the row at a time, on straight lines between rows, shape (columns,)."""
    after = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
    before, after = after - 1, min(after, len(times) - 1)
    width = times[after] - times[before]
    share = 0.0 if width <= 0.0 else float(np.clip((time - times[before]) / width, 0.0, 1.0))
    return (1.0 - share) * rows[before] + share * rows[after]


def _marks(run: RunLog, time: Floats, phases: tuple[str, ...], began: float) -> tuple[Mark, ...]:
    """Return the causes of the end, the changes of the phase, and warnings and faults."""
    first, last = whole_span(run)
    found, said = (
        explain(run),
        [(e.time - began, e.name, e.text.replace("\a", "")) for e in run.events],
    )
    marks = [
        Mark(last if found.log is None else one.time, one.cause, one.evidence, cause=True)
        for one in found.causes
    ]
    marks += [Mark(*event) for event in said if event[1] in FAULTS]
    changes = [i for i, phase in enumerate(phases) if i == 0 or phase != phases[i - 1]]
    for i in changes:
        when, name = float(time[i]), phases[i]
        text = next((t for at, n, t in said if n == name and abs(at - when) < SAME_TIME), "")
        marks.append(Mark(when, name, text))
    if not phases:
        marks.append(Mark(0.0, "release"))
    marks = [mark for mark in marks if isfinite(mark.time)][:MAX_MARKS]
    inside = (mark._replace(time=min(max(mark.time, first), last)) for mark in marks)
    return tuple(sorted(inside, key=lambda mark: mark.time))
