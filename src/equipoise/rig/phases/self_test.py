"""Self-test swing of the hanging pendulum, and its zero."""

from collections.abc import Callable, Sequence
from functools import partial
from math import pi
from typing import Final

import numpy as np

from equipoise.control.minimum_jerk import Path
from equipoise.control.ticks import Sample
from equipoise.identification.driven_swing import (
    MOVE_TIME,
    SWING_TIME,
    SelfTest,
    SelfTestVerdict,
    flange_move,
    self_test,
)
from equipoise.outcomes import End, Outcome, Phase
from equipoise.rig.phases.context import RunContext, RunPhase, Setpoints
from equipoise.rig.phases.exciting import Exciting
from equipoise.rig.phases.release import Lifting

REST_BEFORE: Final = 0.3
"""Observation of the pendulum before the move [s]."""
RETURN_TIME: Final = 1.6
"""Duration of the way back from the self-test [s]: twice that of the way out."""
HOME_TOLERANCE: Final = 2e-5
"""Largest distance of the flange from home at which the balance may begin [m]: as an error of the
first setpoint it is an acceleration of 1 m/s^2."""
MAX_SWINGS: Final = 4
"""Maximum number of swings of a self-test, repeated until the zero's interval is small."""


class SelfTesting(RunPhase):
    """The flange moves by 40 mm, the pendulum answers and swings out, and the flange returns."""

    kind, moves = Phase.SELF_TEST, True

    def __init__(self, run: RunContext, reference: Callable[[RunContext], RunPhase]) -> None:
        """Create the phase; `reference` makes the phase that takes a refused zero anew."""
        super().__init__(run)
        self._reference = reference
        self._swings = 0
        self._swing(REST_BEFORE)
        self._judged: SelfTest | None = None

    def _swing(self, begin: float) -> None:
        """Plan a swing that begins at a time of the phase [s], to the other side each time."""
        self._path = flange_move(self.run.controller.x, -1.0 if self._swings % 2 else 1.0)
        self._begin, self._asked = begin, False
        self._swings += 1
        self._encoder, self._pivot = list[tuple[float, float]](), list[tuple[float, float]]()

    def enter(self) -> None:
        """Warn of the motion."""
        self.run.notify("swing", "Self-test: the arm moves by 40 mm. Keep your hands off.")

    def take_sample(self, sample: Sample) -> None:
        """Record the swing."""
        if not self._asked:
            self._encoder.append((sample.time, sample.counts))

    def take_joints(self, time: float, q: Sequence[float]) -> None:
        """Record the pivot."""
        if not self._asked:
            self._pivot.append((time, self.run.flange.pose(tuple(q)).x))

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Go on from rest."""
        self.run.rest_on_track(missed, unsent)

    def wait(self, now: float) -> Setpoints:
        """Hold the controller, too."""
        setpoints = super().wait(now)
        self.run.controller.hold()
        return setpoints

    def tick(self, now: float) -> Setpoints:
        """Move, record and judge the swing, then return home."""
        run, h = self.run, self.run.h
        if self._judged is not None:
            return self._return(self._judged)
        t = self.ticks * h - self._begin
        if -REST_BEFORE <= t < MOVE_TIME - 0.5 * h:
            return run.glide(self._path, t)
        if t >= MOVE_TIME + SWING_TIME and not self._asked:
            self._asked = True
            params = run.response.params
            run.job = partial(
                self_test,
                *np.array(self._encoder).reshape(-1, 2).T.copy(),
                *np.array(self._pivot).reshape(-1, 2).T.copy(),
                pendulum=params.pendulum,
                counts_per_rev=round(2.0 * pi / params.resolution),
                resting=run.encoder.zero or 0.0,
                delay=0.0,
            )
        if self._asked and run.result is not None:
            failure = self._judge(run.result)
            if failure is not None:
                return run.stop_and_rest(End(Outcome.SELF_TEST, {"text": failure}), now)
        return run.command(0.0)

    def _judge(self, result: SelfTest | Exception) -> str | None:
        """Act on the verdict; return why the run has to stop, if it has to."""
        run, h = self.run, self.run.h
        if isinstance(result, Exception):
            return f"the self-test failed ({result})"
        run.notify("self-test", f"Self-test: {result.reason}.")
        if result.verdict is SelfTestVerdict.REPEAT and self._swings < MAX_SWINGS:
            self._swing(self.ticks * h + REST_BEFORE)
        elif result.verdict in (SelfTestVerdict.PASSED, SelfTestVerdict.ZERO):
            self._judged = result
            self._go_home()
        else:
            return result.reason
        return None

    def _go_home(self) -> None:
        self._path = Path((self.run.controller.x,), (0.0,), RETURN_TIME)
        self._begin = (self.ticks + 1) * self.run.h

    def _return(self, judged: SelfTest) -> Setpoints:
        """Return home, and go on to the next phase."""
        run, h = self.run, self.run.h
        t = self.ticks * h - self._begin
        if t < RETURN_TIME + REST_BEFORE:
            return run.glide(self._path, t)
        if abs(run.controller.x) > HOME_TOLERANCE:  # a stall has cost a part of the way
            self._go_home()
            return run.glide(self._path, -h)
        if judged.verdict is SelfTestVerdict.ZERO:
            run.go(self._reference(run))
            return run.still()
        run.encoder.zero = (run.encoder.zero or 0.0) + judged.zero / run.response.params.resolution
        identify = run.request.identify
        run.go(Lifting(run) if identify is None else Exciting(run, identify))
        return run.still()
