"""The way to rest after a stop, inside the servo stream."""

from typing import Final

import numpy as np

from equipoise.outcomes import Phase
from equipoise.rig.phases.context import RunContext, RunPhase, Setpoints
from equipoise.safety import rules
from equipoise.safety.stop import StopMotion, stoppable_speeds

SETTLING_TIME: Final = 0.5
"""Hold after a ramp before the servo ends [s]."""


class Stopping(RunPhase):
    """On the way to rest. Latched: no phase follows."""

    kind = Phase.STOPPING

    def __init__(self, run: RunContext) -> None:
        """Create the phase, for the stop that may come."""
        super().__init__(run)
        self._motion: StopMotion | None = None
        self._before_stop = np.zeros((0, len(run.q)))
        self._returned = False

    @property
    def on_track(self) -> bool:
        """Whether the rules of the flange apply, as in the phase before."""
        return self.run.before.on_track

    @property
    def done(self) -> bool:
        """Whether the arm rests, and the servo may end."""
        return self._motion is not None and self._motion.rested > SETTLING_TIME

    @property
    def flange_speed(self) -> float | None:
        """Commanded velocity of the flange along x [m/s]; None before the first setpoint."""
        if self._motion is None:
            return None
        q, dq, h, flange = self._motion.q, self._motion.dq, self.run.h, self.run.flange
        before = [place - h * rate for place, rate in zip(q, dq, strict=True)]
        return (flange.pose(q).x - flange.pose(before).x) / h

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Hold the arm where it rests; a hold that has begun goes on, so that the run ends."""
        if self._motion is not None and not self._motion.at_rest:
            self._motion.rest(self.run.q)

    def tick(self, now: float) -> Setpoints:
        """Return the next setpoints on the way to rest."""
        run, motion = self.run, self._motion
        if motion is None:
            motion = self._motion = self._ramp()
        elif motion.goes_back and (reason := self._hold_reason()):
            motion.hold()
            run.notify("warning", f"The target holds: {reason}.")
        elif motion.at_rest and run.from_measured and not self._returned:
            self._returned = True
            self._go_back(motion)
        setpoints = motion.advance(run.h)
        run.q, run.dq = motion.q, motion.dq
        return setpoints

    def _ramp(self) -> StopMotion:
        """Return the ramp to rest from the last setpoint."""
        run = self.run
        before, last = run.sent.last_two()
        dq = stoppable_speeds(run.dq, last, before, 0.5 * run.h)
        speed = abs(run.controller.x_dot) if self.on_track else 0.0
        self._before_stop = run.sent.setpoints.copy()
        return StopMotion(run.q, dq, speed, run.response.safety.limits)

    def _hold_reason(self) -> str:
        """Return why the target holds after a stop, though the arm is elsewhere; empty for none."""
        return "a key was pressed" if self.run.key_after_stop else self.run.forbidden

    def _go_back(self, motion: StopMotion) -> None:
        """Begin the way back towards the measured posture, or say why the target holds."""
        measured = self.run.joints.q
        away, joint = rules.largest_difference(measured, motion.q)
        place = f"Joint {joint} is measured {away:.3g} rad from its target"
        reason = self._hold_reason()
        if doubt := self.run.joints.plausibility.doubt(measured, self._before_stop):
            reason = f"the measurement is not plausible ({doubt})"
        if reason:
            text = f"{place}, which holds: {reason}. Look at the arm."
        else:
            moved = motion.go_back(measured)
            text = f"{place}, which goes back by {moved:.3f} rad. Any key ends this."
        self.run.notify("warning", text)
