"""The operator lifts the pendulum, holds it still, and releases it."""

from equipoise.control.ticks import Sample
from equipoise.outcomes import Phase
from equipoise.rig.phases.balancing import Balancing
from equipoise.rig.phases.context import RunContext, RunPhase, Setpoints
from equipoise.rig.release import ReleaseDetector, ReleaseState


class Lifting(RunPhase):
    """Held, the operator lifts the pendulum; armed while it stands in a hand that may release it.

    Its kind is `Phase.LIFTING` or `Phase.ARMED`, as the detector says.
    """

    kind = Phase.LIFTING

    def __init__(self, run: RunContext) -> None:
        """Create the phase, the pendulum hanging."""
        super().__init__(run)
        self._detector = ReleaseDetector(run.response.params.pendulum)

    def enter(self) -> None:
        """Ask for the lift."""
        text = "Lift the pendulum until it stands upright, and hold it there."
        self.run.notify("lift", text)

    def take_sample(self, sample: Sample) -> None:
        """Watch the pendulum."""
        self._detector.feed(sample.time, self.run.encoder.phi())

    def tick(self, now: float) -> Setpoints:
        """Wait for the release, in which the policy begins."""
        run, state = self.run, self._detector.state
        if state is ReleaseState.RELEASED:
            balancing = Balancing(run)
            run.began = now
            run.go(balancing)
            return balancing.decide(now, first=True)
        kind = Phase.ARMED if state is ReleaseState.ARMED else Phase.LIFTING
        interval = round(5.0 / run.h)  # 5 s
        if kind is not self.kind:
            self.kind, self.ticks = kind, 0
            if kind is Phase.ARMED:
                run.notify("armed", "\aArmed. Let go.")
            else:
                run.notify("disarmed", "You are still holding the pendulum. Hold it upright again.")
        elif kind is Phase.ARMED and self.ticks % interval == interval - 1:
            run.notify("nudge", "Let go. If it stands by itself, nudge it.")
        return run.still()
