"""Self-test swing of the hanging pendulum, its zero, and the selection of an actuator."""

from collections.abc import Callable, Sequence
from functools import partial
from math import pi
from typing import Final

import numpy as np

from equipoise.control.actuator_choice import (
    REST_AFTER_MOVE,
    MotionRecord,
    choose_actuator,
    describe_choice,
)
from equipoise.control.minimum_jerk import Path
from equipoise.control.self_test import (
    MOVE_TIME,
    SWING_TIME,
    SelfTest,
    SelfTestVerdict,
    excitation,
    self_test,
)
from equipoise.control.ticks import Sample
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
        self._motion = MotionRecord() if run.parts.alternatives else None
        self._judged: SelfTest | None = None
        self._selects = False
        self._chosen: int | None = None

    def _swing(self, begin: float) -> None:
        """Plan a swing that begins at a time of the phase [s], to the other side each time."""
        self._path = excitation(self.run.controller.x, -1.0 if self._swings % 2 else 1.0)
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
        """Record the pivot, and the move."""
        run = self.run
        if not self._asked:
            self._pivot.append((time, run.flange.pose(tuple(q)).x))
        if self._motion is not None and self._records_move:
            self._motion.measure(time, run.parts.arm.without_held(q))

    def note_sent(self, time: float, q: Sequence[float]) -> None:
        """Record the move."""
        if self._motion is not None and self._records_move:
            self._motion.send(time, self.run.parts.arm.without_held(q))

    @property
    def _records_move(self) -> bool:
        """Whether the first move is under way, from which an actuator is selected."""
        if self._judged is not None or self._swings > 1:
            return False
        return self.ticks * self.run.h - self._begin < MOVE_TIME + REST_AFTER_MOVE

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Go on from rest; a move with a pause selects no actuator."""
        if self._motion is not None and self._records_move:
            self._motion.clear()
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
            return self._return(now, self._judged)
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
            if self._motion is not None and result.verdict is SelfTestVerdict.PASSED:
                carried = tuple(each.actuator for each in run.parts.alternatives)
                run.job = partial(choose_actuator, carried, *self._motion.values())
                self._selects = True
            self._go_home()
        else:
            return result.reason
        return None

    def _go_home(self) -> None:
        self._path = Path((self.run.controller.x,), (0.0,), RETURN_TIME)
        self._begin = (self.ticks + 1) * self.run.h

    def _return(self, now: float, judged: SelfTest) -> Setpoints:
        """Return home, take the selected actuator, and go on to the next phase."""
        run, h = self.run, self.run.h
        t = self.ticks * h - self._begin
        if self._selects and isinstance(run.result, Exception):
            text = f"the selection of an actuator failed ({run.result})"
            return run.stop_and_rest(End(Outcome.SELF_TEST, {"text": text}), now)
        if self._selects and run.result is not None:
            self._selects, self._chosen = False, int(np.argmin(run.result))
            carried = [each.actuator for each in run.parts.alternatives]
            run.notify("actuator", describe_choice(run.result, carried))
        if t < RETURN_TIME + REST_BEFORE or self._selects:
            return run.glide(self._path, t)
        if abs(run.controller.x) > HOME_TOLERANCE:  # a stall has cost a part of the way
            self._go_home()
            return run.glide(self._path, -h)
        if judged.verdict is SelfTestVerdict.ZERO:
            run.go(self._reference(run))
            return run.still()
        run.encoder.zero = (run.encoder.zero or 0.0) + judged.zero / run.response.params.resolution
        if self._chosen is not None:
            run.assume(run.parts.alternatives[self._chosen])
        plan = run.parts.excitation
        run.go(Lifting(run) if plan is None else Exciting(run, plan))
        return run.still()
