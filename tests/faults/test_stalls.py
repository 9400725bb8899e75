"""Stalls of loop, encoder and link at random moments of a balance, on the emulated rig."""

from math import inf

import numpy as np
import pytest

from equipoise.outcomes import MAX_STALL, Outcome
from equipoise.rig.config import RigSettings
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.faults.verdicts import check_limits, setpoints_of

pytestmark = pytest.mark.slow

ARM = RigSettings().described_arm
SPEEDS = np.array([joint.velocity for joint in ARM.joints])
STOPS = {Outcome.TICK, Outcome.ENCODER_STALE, Outcome.LINK, Outcome.LINK_LOST}
STALLS = 100


class Balance:
    """A run with a stall every 2 to 3 s."""

    def __init__(self, part, stall, seed, duration):
        self.part, self.stall, self.random = part, stall, np.random.default_rng(seed)
        self.next, self.until, self.stalls, self.fastest = 1.0, -inf, 0, 0.0
        scenario = Scenario(duration=duration)
        stalls = Trigger("balancing"), lambda harness: harness.each(self.work)
        harness = FaultHarness(scenario, stalls, words_after_stop=False, seed=seed)
        self.harness = harness
        self.link = {"link": harness.robot.link, "encoder": harness.sensor.link}.get(part)
        self.usual = self.link and self.link.delay
        self.end = self.harness.run()

    def work(self, now):
        if self.harness.messages[-1].name in ("stopping", "fault"):
            return
        moving = np.abs(self.harness.bench.twin.data.qvel[: len(SPEEDS)])
        self.fastest = max(self.fastest, float((moving / SPEEDS).max()))
        if self.link is not None:
            for end in (self.link, self.link.other):
                end.delay = max(self.usual, self.until - now)
        if now >= self.next:
            self.next = now + self.random.uniform(2.0, 3.0)
            self.until, self.stalls = now + self.stall, self.stalls + 1
            if self.link is None:
                self.harness.clock.stalls.append(self.stall)


@pytest.mark.parametrize("stall", [0.02, 0.03, 0.04, 0.06, 0.09])
@pytest.mark.parametrize("part", ["loop", "encoder", "link"])
def test_stalls_at_random_moments_end_as_the_rule_says(part, stall):
    stalls, lost, seed = 0, [], 0
    wanted = STALLS if stall <= MAX_STALL else 5
    while stalls < wanted:
        balance = Balance(part, stall, seed, min(60.0, 2.5 * (wanted - stalls) + 1.0))
        stalls, seed = stalls + balance.stalls, seed + 1
        if balance.end.outcome != "survived":
            lost.append(balance.end.outcome)
        assert balance.fastest < 1.0
        assert not check_limits(ARM, setpoints_of(balance.harness.robot_tap.sent))
    if stall > MAX_STALL:
        assert len(lost) == stalls
        assert set(lost) <= STOPS
    else:
        assert len(lost) <= 0.05 * stalls
