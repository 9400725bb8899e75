"""Excitation of every joint before the lift, which identifies the arm."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from equipoise.arrays import Array
from equipoise.errors import InputError
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.outcomes import End, Outcome, Phase
from equipoise.printable import printable
from equipoise.rig.checks import actuator_fits
from equipoise.rig.phases.context import RunContext, RunPhase, Setpoints
from equipoise.rig.phases.release import Lifting
from equipoise.rig.request import describe_fit


class Exciting(RunPhase):
    """Every joint moves about home, the pendulum hanging; then the arm is identified."""

    kind, moves = Phase.EXCITING, True

    def __init__(self, run: RunContext, identify: Callable[[Array, Array], Actuator]) -> None:
        """Create the phase; `identify` is that of the request."""
        super().__init__(run)
        self._identify, self._measures = identify, True
        self._sent, self._measured = list[tuple[float, ...]](), list[tuple[float, ...]]()

    @property
    def on_track(self) -> bool:
        """Whether the rules of the flange apply: it leaves its line."""
        return False

    def enter(self) -> None:
        """Warn of the motion."""
        seconds = 0.5 * self.run.h * len(self.run.excitation)
        text = f"Excitation: every joint moves about home for {seconds:.0f} s. Keep away."
        self.run.notify("excitation", text)

    def take_joints(self, time: float, q: Sequence[float]) -> None:
        """Record the response."""
        if self._measures:
            self._measured.append((time, *self.run.arm.without_held(q)))

    def note_sent(self, time: float, q: Sequence[float]) -> None:
        """Record the setpoints."""
        if self._measures:
            self._sent.append((time, *self.run.arm.without_held(q)))

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Stop: an excitation with a gap identifies nothing."""
        if self._measures:
            self.run.stop(_interrupted("the computer"))

    def wait(self, now: float) -> Setpoints:
        """Stop: an excitation with a gap identifies nothing."""
        return self.run.stop_and_rest(_interrupted("the robot's link"), now)

    def tick(self, now: float) -> Setpoints:
        """Move every joint, identify the arm, and assume what was found."""
        run, setpoints = self.run, self.run.excitation
        row, h = 2 * self.ticks, run.h
        if row < len(setpoints):
            first, second = (tuple(each) for each in setpoints[row - 1 : row + 1].tolist())
            speeds = (setpoints[row] - setpoints[row - 1]) / (0.5 * h)
            run.q, run.dq = second, tuple(speeds.tolist())
            return first, second
        over = (row - len(setpoints)) * 0.5 * h
        if over > 0.3 and self._measures:
            self._measures = False
            run.job = partial(self._identify, _motion(self._sent), _motion(self._measured))
            run.notify("notice", "The arm is identified; this takes some seconds.")
        if run.result is not None:
            try:
                if isinstance(run.result, Exception):
                    raise run.result
                found: Actuator = run.result
                run.identified = found
                text = describe_fit(run.request.policy, found)
                if not actuator_fits(run.request.policy, found):
                    raise InputError(text)
                response = run.respond(found)
            except Exception as error:  # the arm comes to rest, whatever failed
                end = End(Outcome.UNIDENTIFIED, {"text": printable(str(error))})
                return run.stop_and_rest(end, now)
            run.notify("identified", text)
            run.assume(response)
            run.go(Lifting(run))
        return run.still()


def _motion(rows: list[tuple[float, ...]]) -> Array:
    """Return times [s] and free joints [rad] in an array, shape (m, 7), each time once."""
    motion = np.array(rows).reshape(-1, 1 + FREE_JOINTS)
    return motion[np.unique(motion[:, 0], return_index=True)[1]]


def _interrupted(part: str) -> End:
    text = f"{part} stood still during the excitation; run again"
    return End(Outcome.UNIDENTIFIED, {"text": text})
