"""The policy balances the pendulum."""

from math import isfinite, nan
from typing import Final

from equipoise.control.ticks import TickRecord
from equipoise.outcomes import End, Outcome, Phase
from equipoise.printable import printable
from equipoise.rig.phases.context import LINK_STALLED, RunPhase, Setpoints

POLICY_TIME_SHARE: Final = 0.5
"""Maximum computing time of the policy, as a share of a tick [-]: later, the second setpoint, due
after half a tick, would be late too."""


class Balancing(RunPhase):
    """The policy commands."""

    kind, moves = Phase.BALANCING, True

    def enter(self) -> None:
        """Begin with the state of the falling pendulum."""
        run = self.run
        w2 = run.response.params.pendulum.w2
        run.controller.begin(*run.encoder.falling(run.began or 0.0, w2))
        run.lost_speed = 0.0
        run.notify("balancing", "Balancing. Press any key to stop.")

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Go on from rest; missed ticks count."""
        self.run.rest_on_track(missed, unsent)
        self.ticks += missed

    def wait(self, now: float) -> Setpoints:
        """Send nothing while the link stands still; the time of the balance goes on."""
        run = self.run
        run.begin_anew(0, 0, LINK_STALLED)
        run.controller.hold()
        self._record(0.0)
        return ()

    def tick(self, now: float) -> Setpoints:
        """Command the policy's acceleration, until the run has lasted."""
        run, end = self.run, None
        if not run.encoder.samples or run.encoder.zero is None:  # it follows from a reference
            end = End(Outcome.ENCODER_LOST, {"text": "the encoder shows nothing"})
        elif run.controller.limit_exceeded:
            end = End(Outcome.JOINT_LIMIT)
        elif self.ticks * run.h >= run.request.duration - 0.5 * run.h:
            end = End(Outcome.LASTED, {"duration": run.request.duration})
        return self.decide(now) if end is None else run.stop_and_rest(end, now)

    def decide(self, now: float, *, first: bool = False) -> Setpoints:
        """Command the policy's u; stop where the policy fails, for u is then of no use."""
        run, u, policy = self.run, nan, self.run.policy
        began = run.clock()
        try:
            if first:
                policy.reset()
            u = run.controller.decide(policy)
            failure = "" if isfinite(u) else f"it returned {u}"
        except BaseException as error:  # not even a request to exit may end the loop
            failure = printable(str(error)) or type(error).__name__
        evidence: dict[str, float | str] = {}
        took, limit = run.clock() - began, POLICY_TIME_SHARE * run.h
        if not failure and took > limit:
            failure = f"it took {1e3 * took:.1f} ms, expected at most {1e3 * limit:.1f} ms"
            evidence = {"took": took, "limit": limit}
        self._record(0.0 if failure else u)
        if failure:
            end = End(Outcome.POLICY, {"text": failure, **evidence})
            return run.stop_and_rest(end, now)
        return run.command(u)

    def _record(self, u: float) -> None:
        controller = self.run.controller
        observed, estimate = controller.observation, controller.estimate
        self.run.record = TickRecord(*observed, controller.box, u, *estimate)
