"""Checks before a run, and their measurements of devices and clocks in virtual time."""

from types import SimpleNamespace

import numpy as np
import pytest

from equipoise import Actuator, shipped_policy
from equipoise.rig import checks
from equipoise.rig.checks import TimedClock, listen, round_trips
from equipoise.rig.config import RigSettings
from tests.rig.test_loop import Held
from tests.robots.encoder.rig import Bench as EncoderBench

RIG, POLICY = RigSettings(), shipped_policy()
ACTUATOR, SPREAD = POLICY.actuator, POLICY.settings.plant.delay_spread


def status(findings, name):
    (found,) = [finding for finding in findings if finding.name == name]
    assert (found.remedy in found.sentence) == (found.status != "good")
    return found.status


def deadlines(late, n, **kind):
    return [checks.check_deadlines(np.array([1e-4] * 900 + [late] * n), **kind)]


def link(trip):
    return [checks.check_link(np.full(100, trip))]


def states(gap, n):
    return [checks.check_link(np.array([0.001] * 98 + [gap] * n), paced=True)]


def encoder(**change):
    usual = {"counts": 8192, "rate": 1000.0, "ages": np.full(100, 0.001)}
    return checks.check_encoder(RIG, **usual | {"lost_fraction": 0.0, "illegal": 0} | change)


def fit(**rig):
    return checks.check_fit(POLICY, ACTUATOR, RigSettings(**rig))


def posture(by):
    q = np.array(RIG.described_arm.home)
    q[3] = RIG.described_arm.joints[3].lower + by
    return [checks.check_posture(q, RIG)]


SLUGGISH = Actuator.assumed("kst", delay=0.01, lag=0.02, cycle=0.1)
"""An actuator with which half of the trials fall."""


def later(change):
    delay = ACTUATOR.delay.model_copy(update={"value": ACTUATOR.delay.value + change * SPREAD})
    return checks.check_fit(POLICY, ACTUATOR.model_copy(update={"delay": delay}), RIG)


@pytest.mark.parametrize(
    ("findings", "name", "verdict"),
    [
        (deadlines(1e-4, 100), "deadlines", "good"),
        (deadlines(2e-3, 100), "deadlines", "warning"),
        (deadlines(6e-3, 1), "deadlines", "warning"),
        (deadlines(0.071, 1), "deadlines", "bad"),
        (deadlines(0.019, 1, paced=True), "deadlines", "warning"),
        (deadlines(0.021, 1, paced=True), "deadlines", "bad"),
        (states(0.0019, 2), "link to the robot", "good"),
        (states(0.0021, 2), "link to the robot", "warning"),
        (states(0.021, 1), "link to the robot", "bad"),
        (link(0.0054), "link to the robot", "good"),
        (link(0.0056), "link to the robot", "warning"),
        (link(0.0091), "link to the robot", "bad"),
        (encoder(), "encoder's counts", "good"),
        (encoder(counts=4096), "encoder's counts", "bad"),
        (encoder(), "encoder's samples", "good"),
        (encoder(rate=440.0), "encoder's samples", "warning"),
        (encoder(ages=np.full(100, 0.006)), "encoder's samples", "warning"),
        (encoder(rate=190.0), "encoder's samples", "bad"),
        (encoder(ages=np.full(100, 0.021)), "encoder's samples", "bad"),
        (encoder(lost_fraction=0.009), "encoder's line", "good"),
        (encoder(lost_fraction=0.011), "encoder's line", "warning"),
        (encoder(illegal=1), "encoder's line", "bad"),
        (fit(), "policy and arm", "good"),
        (fit(arm="iiwa14"), "policy and arm", "bad"),
        (fit(home_deg=(90, 31, 0, -70, 0, 80, 0)), "policy and arm", "bad"),
        (fit(counts_per_rev=2048), "encoder's resolution", "bad"),
        (fit(home_deg=(90, 30, 0, -70, 0, 116, 0)), "home", "bad"),
        (posture(0.1), "posture", "good"),
        (posture(0.01), "posture", "bad"),
        (later(0.9), "arm's response", "good"),
        (later(1.1), "arm's response", "good"),
        (checks.check_fit(POLICY, SLUGGISH, RIG), "arm's response", "bad"),
    ],
)
def test_verdicts(findings, name, verdict):
    assert status(findings, name) == verdict


def test_a_slow_link_and_the_request_limit_the_flange():
    arm, fast, slow = RIG.described_arm, np.full(9, 0.002), np.full(9, 0.008)

    def limit(trips, requested, rule=lambda arm, period: 0.4567):
        return checks.max_flange_speed(arm, trips, requested, rule)

    assert limit(fast, None) is None is limit(slow, None, None)
    assert limit(slow, None) == 0.456
    assert limit(slow, 0.23) == limit(fast, 0.23) == 0.23
    assert checks.check_speed(POLICY, None) == []
    assert status(checks.check_speed(POLICY, 0.4), "flange speed") == "warning"


# Measurements.


def test_a_stall_is_late_once():
    inner = Held({20: 0.023})
    clock = TimedClock(inner)
    device = SimpleNamespace(measured=lambda: None)
    np.testing.assert_allclose(round_trips(device, clock, 0.5), 0.0, atol=1e-9)
    assert (max(clock.late), sum(clock.late)) == pytest.approx((0.023, 0.023))


def test_what_is_lost_damaged_or_illegal_is_counted():
    bench = EncoderBench()
    bench.sensor.connect()
    _, rate, ages, *lost = listen(bench.sensor, bench.clock, 1.0)
    assert rate == pytest.approx(1000.0, abs=2.0)
    assert lost == [0.0, 0]
    assert ages.max() <= 0.0021
    trouble = bench.clock.now() + 0.3

    def disturb(now):
        if abs(now - trouble) < 1e-9:
            bench.lose(0.007)
        if abs(now - trouble - 0.1) < 1e-9:
            bench.board.illegal = True

    bench.clock.attach(disturb)
    _, _, ages, *lost = listen(bench.sensor, bench.clock, 0.5)
    assert lost == [pytest.approx(7 / 500, rel=0.02), 1]
    assert ages.max() >= 0.007 - 1e-9
