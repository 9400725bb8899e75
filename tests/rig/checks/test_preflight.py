"""What the pre-flight finds of links, with made-up devices in virtual time."""

import numpy as np
import pytest

from equipoise.rig.checks.encoder import check_encoder, listen
from equipoise.rig.checks.link import check_link, round_trips
from equipoise.rig.checks.results import Spread
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.interfaces import Sample
from equipoise.rig.run import MEASURING_TIME

RIG = RigSettings()


class Robot:
    """A robot at home that answers after a time; each tenth answer may take longer."""

    joints = 7

    def __init__(self, clock, takes, tenth=None):
        self.clock, self.takes, self.tenth = clock, takes, takes if tenth is None else tenth
        self.asked = 0

    def measured(self):
        self.asked += 1
        late = self.tenth if self.asked % 10 == 0 else self.takes
        self.clock.wait_until(self.clock.now() + late)
        return np.array(RIG.described_arm.home)


class Sensor:
    """An encoder whose driver gives out a hundred samples at most per call."""

    counts_per_rev = 8192
    rejected = 0

    def __init__(self, clock, *, rate=1000.0, waiting=0.0, lost=0.0, illegal=False):
        self.clock, self.rate, self.lost, self.illegal = clock, rate, lost, illegal
        self.given = -int(waiting * rate)
        self.begin = clock.now()

    def samples(self):
        there = int((self.clock.now() - self.begin) * self.rate + 1e-6)
        new = range(self.given + 1, min(there, self.given + 100) + 1)
        self.given = max(new, default=self.given)
        missing = [int(self.lost > 0.0 and n % round(1 / self.lost) == 0) for n in new]
        return [
            Sample(self.begin + n / self.rate, 5, False, self.illegal, m)
            for n, m in zip(new, missing, strict=True)
        ]


@pytest.mark.parametrize(
    ("takes", "tenth", "verdict"),
    [
        (0.002, None, "good"),
        (0.005, None, "good"),
        (0.002, 0.007, "warning"),
        (0.002, 0.010, "bad"),
        (0.050, None, "bad"),
    ],
)
def test_the_link_is_judged_by_its_slowest_answers(takes, tenth, verdict):
    clock = VirtualClock()
    link = check_link(Spread.of(round_trips(Robot(clock, takes, tenth), clock, MEASURING_TIME)))
    assert (link.verdict, link.outside) == (verdict, True)
    assert bool(link.cure) == (verdict != "good")
    assert clock.now() < 1.2


def encoder(**sensor):
    clock = VirtualClock()
    return list(check_encoder(listen(Sensor(clock, **sensor), clock, 1.0)))


@pytest.mark.parametrize(
    ("sensor", "verdict", "says"),
    [
        ({}, "good", "1000 per second"),
        ({"rate": 300.0}, "warning", "latency timer"),
        ({"rate": 100.0}, "bad", "native USB"),
        ({"lost": 0.005}, "good", "5 samples lost"),
        ({"lost": 0.05}, "warning", "change the cable"),
        ({"illegal": True}, "bad", "supply, screen and plugs"),
        ({"rate": 100.0, "lost": 0.05}, "bad", "native USB"),
    ],
)
def test_the_encoder_is_judged_by_rate_losses_and_signals(sensor, verdict, says):
    found = encoder(**sensor)
    order = ("good", "warning", "bad")
    assert max((one.verdict for one in found), key=order.index) == verdict
    assert any(says in f"{one.found}; {one.cure}" for one in found)
    assert all(one.outside for one in found[1:]), "the rig is at fault, not what was given"


def test_what_waited_before_does_not_count_for_the_rate():
    samples = encoder(rate=150.0, waiting=4.0)[1]
    assert samples.verdict == "bad"
    assert "150 per second" in samples.found
