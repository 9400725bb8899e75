"""Checks before a run, and their measurements of devices and clocks in virtual time."""

import time
from ast import literal_eval
from math import inf
from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.errors import InputError, LinkError
from equipoise.rig import checks
from equipoise.rig.checks import Finding, TimedClock, examine, listen, require, round_trips
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from tests.robots.encoder.rig import Bench as EncoderBench

RIG, POLICY = RigSettings(), shipped_policy()
ACTUATOR, SPREAD = POLICY.actuator, POLICY.settings.plant.delay_spread


def status(findings, name):
    (found,) = [finding for finding in findings if finding.name == name]
    assert bool(found.remedy) == (found.status != "good")
    return found.status


def test_bad_findings_are_raised():
    good, warning, bad = (Finding(kind, kind, "2 ms") for kind in ("good", "warning", "bad"))
    require([good, warning])
    with pytest.raises(InputError, match="bad: 2 ms"):
        require([good, bad])


def deadlines(late, n, **kind):
    return [checks.check_deadlines(np.array([1e-4] * 900 + [late] * n), **kind)]


def link(trip):
    return [checks.check_link(np.full(100, trip))]


def states(gap, n):
    return [checks.check_link(np.array([0.001] * 98 + [gap] * n), paced=True)]


def encoder(**change):
    usual = {"counts": 8192, "rate": 1000.0, "ages": np.full(100, 0.001)}
    return checks.check_encoder(RIG, **usual | {"lost_share": 0.0, "illegal": 0} | change)


def fit(**rig):
    return checks.check_fit(POLICY, ACTUATOR, RigSettings(**rig))


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
        (encoder(lost_share=0.009), "encoder's line", "good"),
        (encoder(lost_share=0.011), "encoder's line", "warning"),
        (encoder(illegal=1), "encoder's line", "bad"),
        (fit(), "policy and arm", "good"),
        (fit(arm="iiwa14"), "policy and arm", "bad"),
        (fit(home_deg=(90, 31, 0, -70, 0, 80, 0)), "policy and arm", "bad"),
        (fit(counts_per_rev=2048), "encoder's resolution", "bad"),
        (fit(home_deg=(90, 30, 0, -70, 0, 116, 0)), "home", "bad"),
        (later(0.9), "arm's response", "good"),
        (later(1.1), "arm's response", "bad"),
    ],
)
def test_verdicts(findings, name, verdict):
    assert status(findings, name) == verdict


def test_a_home_copied_from_the_message_is_accepted():
    home = (90.0, 30.123456789, 0.0, -70.0, 1e-7, 100.456789, 0.0)
    at_home = RigSettings(home_deg=home).described_arm
    other = POLICY.model_copy(update={"arm": at_home})
    found = checks.check_fit(other, ACTUATOR, RIG)[0].found
    copied = literal_eval(found.partition("is for ")[2])
    assert checks.check_fit(other, ACTUATOR, RigSettings(home_deg=copied))[0].status == "good"
    assert "home" not in fit(arm="iiwa14")[0].found  # which is the same


def test_a_joint_near_its_limit_is_named():
    q = np.array(RIG.described_arm.home)
    assert checks.check_posture(q, RIG).status == "good"
    q[3] = RIG.described_arm.joints[3].lower + 0.01
    assert checks.check_posture(q, RIG).status == "bad"
    assert RIG.described_arm.joints[3].name in checks.check_posture(q, RIG).found


def test_a_slow_link_and_the_request_limit_the_flange():
    arm, fast, slow = RIG.described_arm, np.full(9, 0.002), np.full(9, 0.008)

    def limit(trips, requested, rule=lambda arm, period: 0.4567):
        return checks.max_flange_speed(arm, trips, requested, rule)

    assert limit(fast, None) == inf == limit(slow, None, None)
    assert limit(slow, None) == 0.456
    assert limit(slow, 0.23) == limit(fast, 0.23) == 0.23
    assert checks.check_speed(POLICY, inf) == []
    assert status(checks.check_speed(POLICY, 0.4), "flange speed") == "warning"


def test_a_robot_that_sets_the_pace_is_asked_for_each_state_and_needs_a_real_time_kernel(
    monkeypatch, tmp_path
):
    def measured():
        time.sleep(0.001)
        return np.zeros(7)

    other = dict.fromkeys(("connect", "close"), lambda: None)
    device = SimpleNamespace(joints=7, measured=measured, **other)
    monkeypatch.setattr(checks, "prepare", lambda: {"own core": "granted"})
    monkeypatch.setattr(checks.Path, "exists", lambda _: False)
    found = examine(device, None, None, 0.05, paced=True)
    assert status(found, "kernel") == "warning"
    assert "a state each 1." in next(one.found for one in found if one.name == "link to the robot")


@pytest.mark.parametrize(("fails", "name"), [(False, "link to the robot"), (True, "robot")])
def test_a_device_is_closed_whatever_happens(monkeypatch, fails, name):
    done = []

    def connect():
        done.append("connect")
        if fails:
            raise LinkError("nobody there")

    monkeypatch.setattr(checks, "prepare", lambda: {"memory locked": "denied"})
    close, measured = lambda: done.append("close"), lambda: np.zeros(7)
    device = SimpleNamespace(connect=connect, close=close, measured=measured)
    found = examine(device, None, None, 0.02)
    assert done == ["connect", "close"]
    assert status(found[:1], "memory locked") == "warning"
    assert (found[-1].name, found[-1].status == "bad") == (name, fails)


# Measurements.


class StallingClock:
    """Time that stalls: whoever waits over `at` wakes up `stall` later."""

    def __init__(self, at, stall):
        self.time, self.at, self.stall = 0.0, at, stall

    def now(self):
        return self.time

    def wait_until(self, moment):
        if moment > self.time:
            stalled = self.time < self.at <= moment
            self.time = moment + stalled * self.stall


def test_a_stall_is_late_once_and_a_slow_device_is_not():
    for trip, late in ((0.001, 0.023), (0.007, 0.0)):  # the loop does not wait for the slower one
        inner = StallingClock(0.1, 0.023)
        clock = TimedClock(inner)
        device = SimpleNamespace(measured=lambda: setattr(inner, "time", inner.time + trip))  # noqa: B023
        np.testing.assert_allclose(round_trips(device, clock, 0.5), trip)
        assert (max(clock.late), sum(clock.late)) == pytest.approx((late, late))


def test_a_robot_slower_than_the_stream_is_asked_for_no_longer():
    clock = VirtualClock()
    slow = SimpleNamespace(measured=lambda: clock.wait_until(clock.now() + 0.050))
    np.testing.assert_allclose(round_trips(slow, clock, 1.0), 0.050)
    assert clock.now() < 1.2


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
            bench.board.skip(7)
            bench.board.meet_illegal()

    bench.clock.attach(disturb)
    _, _, ages, *lost = listen(bench.sensor, bench.clock, 0.5)
    assert lost == [pytest.approx(7 / 500, rel=0.02), 1]
    assert ages.max() >= 0.007 - 1e-9
