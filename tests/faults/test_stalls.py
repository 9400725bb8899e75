"""Stalls of loop, encoder and link at random moments of a balance, on the emulated rig."""

from math import inf

import numpy as np
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.outcomes import Outcome
from equipoise.rig.clocks import DrainingClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.safety.rules import MAX_STALL
from tests.faults.harness import StallingClock, TransportTap
from tests.faults.verdicts import check_limits, setpoints_of

pytestmark = [pytest.mark.compiled_only, pytest.mark.slow]

POLICY, SETTINGS = shipped_policy(), RigSettings()
SPEEDS = np.array([joint.velocity for joint in SETTINGS.described_arm.joints])
STOPS = {Outcome.TICK, Outcome.ENCODER_STALE, Outcome.LINK}
STALLS = 100


class Balance:
    """A run with a stall every 2 to 3 s; it types nothing."""

    def __init__(self, part, stall, seed, duration):
        world = read_world("twin:nominal")
        pendulum = pendulum_on(POLICY.pendulum, world.settings)
        self.parts = emulated_rig(world, SETTINGS, pendulum, robot="kst", seed=seed)
        self.part, self.stall, self.random = part, stall, np.random.default_rng(seed)
        self.clock = StallingClock(self.parts.rig.clock)
        self.tap = TransportTap(self.parts.robot.link.other, self.clock)
        driver = self.parts.robot.driver
        robot = driver(self.tap.open, DrainingClock(self.clock, self.parts.rig.sensor))
        self.links = {"link": self.parts.robot.link, "encoder": self.parts.sensor.link}
        self.usual = {name: link.delay for name, link in self.links.items()}
        self.next, self.until, self.stalls, self.fastest = inf, -inf, 0, 0.0
        self.parts.rig.clock.attach(self.work)
        request = RunRequest(
            POLICY, POLICY.actuator, SETTINGS, "kst://emulated", "serial://emulated", duration,
            seed=seed,
        )  # fmt: skip
        rig = self.parts.rig._replace(robot=robot, clock=self.clock)
        self.end = run_virtually(request, None, self, rig=rig)

    def notify(self, event):
        if event.name == "balancing":
            self.next = self.clock.now() + 1.0
        elif event.name in ("stopping", "fault"):
            self.next = inf

    def read_input(self):
        return []

    def work(self, now):
        if self.next < inf:
            moving = np.abs(self.parts.bench.twin.kernel.bodies.qvel[: len(SPEEDS)])
            self.fastest = max(self.fastest, float((moving / SPEEDS).max()))
        if self.part != "loop":
            link, usual = self.links[self.part], self.usual[self.part]
            for end in (link, link.other):
                end.delay = max(usual, self.until - now)
        if now >= self.next:
            self.next = now + self.random.uniform(2.0, 3.0)
            self.until, self.stalls = now + self.stall, self.stalls + 1
            if self.part == "loop":
                self.clock.stalls.append(self.stall)


@pytest.mark.parametrize("stall", [0.02, 0.03, 0.04, 0.06, 0.09])
@pytest.mark.parametrize("part", ["loop", "encoder", "link"])
def test_stalls_at_random_moments_end_as_the_rule_says(part, stall):
    stalls, lost, seed = 0, [], 0
    wanted = STALLS if stall <= MAX_STALL else 5
    while stalls < wanted:
        balance = Balance(part, stall, seed, min(60.0, 2.5 * (wanted - stalls) + 1.0))
        stalls, seed = stalls + balance.stalls, seed + 1
        if balance.end.outcome != "lasted":
            lost.append(balance.end.outcome)
        assert balance.fastest < 1.0
        assert not check_limits(SETTINGS.described_arm, setpoints_of(balance.tap.sent))
    if stall > MAX_STALL:
        assert len(lost) == stalls
        assert set(lost) <= STOPS | {Outcome.LINK_LOST}
    else:
        assert len(lost) <= 0.05 * stalls
