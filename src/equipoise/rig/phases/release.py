"""The operator lifts the pendulum, holds it still, and releases it."""

from equipoise.control.ticks import Sample
from equipoise.outcomes import Phase
from equipoise.rig.phases.balancing import Balancing
from equipoise.rig.phases.context import RunContext, RunPhase, Setpoints
from equipoise.rig.release import ReleaseDetector, ReleaseState


class Lifting(RunPhase):
    """Held, the operator lifts the pendulum."""

    kind, leads_to = Phase.LIFTING, frozenset({Phase.ARMED})

    def __init__(self, run: RunContext, held: ReleaseDetector | None = None) -> None:
        """Create the phase; `held` is the detector that has found the hand still on, if any."""
        super().__init__(run)
        self._denied = held is not None
        self._detector = held or ReleaseDetector(run.response.params.pendulum)

    def enter(self) -> None:
        """Ask for the lift."""
        if self._denied:
            text = "Your hand is still on. Hold the pendulum upright again."
            self.run.notify("disarmed", text)
        else:
            text = "Lift the pendulum until it stands upright, and hold it there."
            self.run.notify("lift", text)

    def take_sample(self, sample: Sample) -> None:
        """Watch the pendulum."""
        self._detector.feed(sample.time, self.run.encoder.phi())

    def tick(self, now: float) -> Setpoints:
        """Wait until the pendulum stands."""
        if self._detector.state is ReleaseState.ARMED:
            self.run.go(Armed(self.run, self._detector))
        return self.run.still()


class Armed(RunPhase):
    """Held, the pendulum stands in a hand that may release it."""

    kind, leads_to = Phase.ARMED, frozenset({Phase.LIFTING, Phase.BALANCING})

    def __init__(self, run: RunContext, detector: ReleaseDetector) -> None:
        """Create the phase with the detector that has armed."""
        super().__init__(run)
        self._detector = detector

    def enter(self) -> None:
        """Ask for the release."""
        self.run.notify("armed", "\aArmed. Let go.")

    def take_sample(self, sample: Sample) -> None:
        """Watch the pendulum."""
        self._detector.feed(sample.time, self.run.encoder.phi())

    def tick(self, now: float) -> Setpoints:
        """Wait for the release, in which the policy begins."""
        run, state = self.run, self._detector.state
        interval = round(5.0 / run.h)  # 5 s
        if self.ticks % interval == interval - 1:
            run.notify("nudge", "Let go. If it stands by itself, nudge it.")
        if state is ReleaseState.HELD:
            run.go(Lifting(run, self._detector))
        elif state is ReleaseState.RELEASED:
            balancing = Balancing(run)
            run.began = now
            run.go(balancing)
            return balancing.decide(now, first=True)
        return run.still()
