"""The way home, its confirmation, and the reference of the hanging pendulum."""

from typing import Final

from equipoise.control.minimum_jerk import Path, path_within
from equipoise.control.ticks import OK, Sample
from equipoise.outcomes import End, Outcome, Phase
from equipoise.rig.phases.context import RunPhase, Setpoints
from equipoise.rig.phases.self_test import SelfTesting

HOMING_SHARE: Final = 0.1
"""Share of the joints' velocity and acceleration limits on the way home [-]."""
REST_TIME: Final = 2.0
"""Minimum time for which the count stays within one before it is a reference [s]."""


class Homing(RunPhase):
    """On the way home, inside the servo stream."""

    kind, moves = Phase.HOMING, True

    def enter(self) -> None:
        """Plan the path."""
        self._path = self._path_home()
        home = f"Moving to home, {self._path.duration:.1f} s. Press any key to stop, at any time."
        self.run.notify("homing", home)

    @property
    def on_track(self) -> bool:
        """Whether the rules of the flange apply: not yet."""
        return False

    def _path_home(self) -> Path:
        arm = self.run.arm
        velocity = [HOMING_SHARE * joint.velocity for joint in arm.joints]
        acceleration = [HOMING_SHARE * joint.acceleration for joint in arm.joints]
        return path_within(self.run.q, arm.home, velocity, acceleration)

    def tick(self, now: float) -> Setpoints:
        """Follow the path to its end."""
        t = self.ticks * self.run.h
        if t < self._path.duration:
            return self.run.along(self._path, t)
        self.run.go(Confirming(self.run))
        return self.run.still()

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Plan the path anew."""
        self._path, self.ticks = self._path_home(), 0


class Confirming(RunPhase):
    """Held at home, until the operator confirms."""

    kind = Phase.AT_HOME

    def enter(self) -> None:
        """Ask whether this is home."""
        run = self.run
        run.controller.begin(0.0, 0.0)
        run.q = run.controller.q
        question = "Is this home, the spindle level, the track free on both sides? y or n"
        run.ask("home", question, ("y", "n"))

    def tick(self, now: float) -> Setpoints:
        """Wait for the answer."""
        if self.run.answer == "y":
            self.run.go(Referencing(self.run))
        elif self.run.answer == "n":
            return self.run.stop_and_rest(End(Outcome.OPERATOR, {"typed": "n"}), now)
        return self.run.still()


class Referencing(RunPhase):
    """Held, the pendulum hanging, until it is still and the button is pressed."""

    kind = Phase.REFERENCING

    def enter(self) -> None:
        """Begin without a zero."""
        self.run.encoder.zero = None
        self._since = self._newest = 0.0
        self._low = self._high = self._sum = self._number = 0
        self.run.notify("hang", "Let the pendulum hang freely, and steady it with a finger.")

    def take_sample(self, sample: Sample) -> None:
        """Notice since when the count has stayed within one."""
        low, high = min(self._low, sample.counts), max(self._high, sample.counts)
        if self._number == 0 or high - low > 1:
            self._since, self._sum, self._number = sample.time, 0, 0
            low = high = sample.counts
        self._low, self._high, self._newest = low, high, sample.time
        self._sum, self._number = self._sum + sample.counts, self._number + 1

    def tick(self, now: float) -> Setpoints:
        """Ask once the pendulum rests; take the reference on the answer."""
        run = self.run
        if not self._newest - self._since >= REST_TIME:
            run.answers, run.pressed = (), False
        elif not run.answers:
            still = "The pendulum hangs still. Take your hand away, then press its button or Enter."
            run.ask("reference", still, (OK,))
        elif run.pressed or run.answer == OK:
            run.encoder.zero = self._sum / self._number
            run.joints.reference_torques()
            run.go(SelfTesting(run, Referencing))
        return run.still()
