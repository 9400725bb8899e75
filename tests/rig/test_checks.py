"""Checks before a run, and their measurements of devices and clocks in virtual time."""

from contextlib import nullcontext
from math import inf
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.errors import InputError, LinkError
from equipoise.rig import checks
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.findings import Finding, fitness, require
from equipoise.rig.interfaces import Sample
from equipoise.rig.probes import EncoderStream, lateness, listen, round_trips
from equipoise.robots.kst.robot import KstRobot
from tests.robots.encoder.rig import Bench as EncoderBench
from tests.robots.kst.follower import HOME, Bench

RIG, POLICY = RigSettings(), shipped_policy()


def status(findings, name):
    (found,) = [finding for finding in findings if finding.name == name]
    assert bool(found.remedy) == (found.status != "good")
    return found.status


def test_the_worst_finding_decides_and_bad_ones_are_raised():
    good, warning, bad = (
        Finding(name=kind, status=kind, values={"p99_ms": 2.0})
        for kind in ("good", "warning", "bad")
    )
    assert [fitness(found) for found in ([good], [good, warning], [warning, bad])] == [
        "fit",
        "usable with care",
        "not fit",
    ]
    require([good, warning])
    with pytest.raises(InputError, match="bad: p99 2 ms"):
        require([good, bad])


@pytest.mark.parametrize(
    ("late", "deadlines", "stalls"),
    [
        ([1e-4] * 100, "good", "good"),
        ([1e-4] * 90 + [2e-3] * 10, "warning", "good"),
        ([1e-4] * 999 + [6e-3], "warning", "good"),
        ([1e-4] * 900 + [0.03], "warning", "warning"),
        ([1e-4] * 900 + [0.071], "warning", "bad"),
    ],
)
def test_deadlines_and_stalls(late, deadlines, stalls):
    found = checks.check_deadlines(np.array(late))
    assert (status(found, "deadlines"), status(found, "stalls")) == (deadlines, stalls)


def test_a_stall_over_several_deadlines_is_one():
    found = checks.check_deadlines(np.array([0.0, 0.045, 0.040, 0.03, 0.0, 0.025, 0.0]))
    assert found[1].values == {"number": 2, "longest_ms": pytest.approx(45.0)}


@pytest.mark.parametrize(
    ("p99", "verdict"),
    [(0.0054, "good"), (0.0056, "warning"), (0.0089, "warning"), (0.0091, "bad")],
)
def test_the_link_is_judged_by_its_slowest_answers(p99, verdict):
    assert status(checks.check_link(np.full(100, p99)), "link to the robot") == verdict


GOOD_STREAM = EncoderStream(8192, 1000.0, np.full(100, 0.001), 0.0, 0)


@pytest.mark.parametrize(
    ("change", "name", "verdict"),
    [
        ({}, "encoder's counts", "good"),
        ({"counts_per_rev": 4096}, "encoder's counts", "bad"),
        ({}, "encoder's samples", "good"),
        ({"rate": 440.0}, "encoder's samples", "warning"),
        ({"ages": np.full(100, 0.006)}, "encoder's samples", "warning"),
        ({"rate": 190.0}, "encoder's samples", "bad"),
        ({"ages": np.full(100, 0.021)}, "encoder's samples", "bad"),
        ({"lost_share": 0.009}, "encoder's line", "good"),
        ({"lost_share": 0.011}, "encoder's line", "warning"),
        ({"illegal": 1}, "encoder's signals", "bad"),
    ],
)
def test_the_encoder_is_judged_by_counts_rate_losses_and_signals(change, name, verdict):
    assert status(checks.check_encoder(GOOD_STREAM._replace(**change), RIG), name) == verdict


def test_the_counts_of_an_unknown_rig_are_accepted():
    assert status(checks.check_encoder(GOOD_STREAM, None), "encoder's counts") == "good"


@pytest.mark.parametrize(
    ("name", "attribute", "value"),
    [
        ("other work", "getloadavg", (1e3, 0.0, 0.0)),
        ("swap", "swap_memory", SimpleNamespace(used=1)),
        ("room for logs", "disk_usage", SimpleNamespace(free=1 << 29)),
    ],
)
def test_the_machine_is_judged_by_what_the_system_reports(
    monkeypatch, tmp_path, name, attribute, value
):
    monkeypatch.setattr(psutil, attribute, lambda *_: value)
    found = checks.check_host(tmp_path / "not" / "yet")
    assert status(found, name) == "warning"
    assert len(found) == 7


@pytest.mark.parametrize(
    ("rig", "name", "verdict"),
    [
        ({}, "policy and arm", "good"),
        ({"arm": "iiwa14"}, "policy and arm", "bad"),
        ({"home_deg": (90, 31, 0, -70, 0, 80, 0)}, "policy and home", "bad"),
        ({"pivot_mm": (-130, 0, 35)}, "pendulum's pivot", "warning"),
        ({"counts_per_rev": 2048}, "encoder's resolution", "bad"),
        ({"home_deg": (90, 30, 0, -70, 0, 116, 0)}, "home", "bad"),
        ({"table_height_mm": 0.0}, "room below", "good"),
        ({"table_height_mm": 400.0}, "room below", "bad"),
    ],
)
def test_a_policy_has_to_fit_its_rig(rig, name, verdict):
    found = checks.check_fit(POLICY, POLICY.actuator, RigSettings(**rig))
    assert status(found, name) == verdict


@pytest.mark.parametrize(("change", "fits"), [(0.0, True), (0.9, True), (1.1, False)])
def test_an_actuator_fits_within_the_delays_of_the_training(change, fits):
    spread, actuator = POLICY.settings.plant.delay_spread, POLICY.actuator
    value = actuator.delay.value + change * spread
    delay = actuator.delay.model_copy(update={"value": value})
    late = actuator.model_copy(update={"delay": delay})
    assert bool(checks.fitting_actuators(POLICY, late)) == fits
    assert status(checks.check_fit(POLICY, late, RIG), "arm's response") == (
        "good" if fits else "bad"
    )


def test_a_joint_near_its_limit_is_named():
    q = np.array(RIG.described_arm.home)
    assert checks.check_posture(q, RIG).status == "good"
    q[3] = RIG.described_arm.joints[3].lower + 0.01
    assert checks.check_posture(q, RIG).status == "bad"
    assert RIG.described_arm.joints[3].name in str(checks.check_posture(q, RIG).values)


def test_a_slow_link_and_t1_limit_the_flange():
    arm, fast, slow = RIG.described_arm, np.full(9, 0.002), np.full(9, 0.008)

    def limit(trips, t1, rule=lambda arm, period: 0.4567):
        return checks.max_flange_speed(arm, trips, t1, rule)

    assert limit(fast, False) == inf == limit(slow, False, None)
    assert limit(slow, False) == 0.456
    assert limit(slow, True) == limit(fast, True) == checks.T1_SPEED
    assert checks.check_speed(POLICY, inf) == []
    assert status(checks.check_speed(POLICY, 0.4), "flange speed") == "warning"


class Device:
    """A device that notes what is done to it, and may fail."""

    def __init__(self, fails):
        self.fails, self.done = fails, []

    def connect(self):
        self.done.append("connect")
        if self.fails:
            raise LinkError("nobody there")

    def close(self):
        self.done.append("close")

    def measured(self):
        return np.zeros(7)


@pytest.mark.parametrize("fails", [False, True])
def test_a_device_is_closed_whatever_happens(fails, tmp_path):
    device = Device(fails)
    found = checks.examine(
        device, None, None, seconds=0.02, logs=tmp_path, busy=lambda what: nullcontext()
    )
    assert device.done == ["connect", "close"]
    assert (found[-1].name, found[-1].status == "bad") == (
        "robot" if fails else "link to the robot",
        fails,
    )


# Measurements.


class StallingClock:
    """Time that stalls: whoever waits over `at` wakes up `stall` later."""

    def __init__(self, at, stall, always=0.0):
        self.time, self.at, self.stall, self.always = 0.0, at, stall, always

    def now(self):
        return self.time

    def wait_until(self, moment):
        if moment > self.time:
            stalled = self.time < self.at <= moment
            self.time = moment + self.always + stalled * self.stall


def test_a_clock_that_always_wakes_late_does_not_drift():
    late = lateness(StallingClock(np.inf, 0.0, always=0.0003), 5.0)
    np.testing.assert_allclose(late, 0.0003, atol=1e-9)


def test_a_stall_makes_every_deadline_late_that_it_lasts_over():
    late = lateness(StallingClock(0.1, 0.023), 0.5)
    # The deadline at 0.1 s comes 23 ms late, and those 5, 10, 15, 20 ms behind it by what is left.
    np.testing.assert_allclose(late[19:24], (0.023, 0.018, 0.013, 0.008, 0.003), atol=1e-9)
    np.testing.assert_allclose(np.delete(late, range(19, 24)), 0.0, atol=1e-9)


def test_a_robot_slower_than_the_stream_is_asked_for_no_longer():
    clock = VirtualClock()
    slow = SimpleNamespace(measured=lambda: clock.wait_until(clock.now() + 0.050))
    np.testing.assert_allclose(round_trips(slow, clock, 1.0), 0.050)
    assert clock.now() < 1.2


def test_a_kst_robot_answers_through_its_server_and_does_not_move():
    bench = Bench(delay=0.002)
    robot = KstRobot(lambda: bench.client, bench.clock)
    robot.connect()
    trips = round_trips(robot, bench.clock, 1.0)
    # Each way takes 2 ms; server and driver look once a millisecond.
    assert trips.min() >= 0.004 - 1e-9
    assert trips.max() <= 0.006 + 1e-9
    assert bench.body.targets == []
    assert bench.body.measured() == HOME


def test_what_is_lost_damaged_or_illegal_is_counted():
    bench = EncoderBench()
    bench.sensor.connect()
    heard = listen(bench.sensor, bench.clock, 1.0)
    assert heard.rate == pytest.approx(1000.0, abs=2.0)
    assert (heard.lost_share, heard.illegal) == (0.0, 0)
    assert heard.ages.max() <= 0.0021
    trouble = bench.clock.now() + 0.3

    def disturb(now):
        if abs(now - trouble) < 1e-9:
            bench.board.skip(7)
            bench.board.meet_illegal()

    bench.clock.attach(disturb)
    heard = listen(bench.sensor, bench.clock, 0.5)
    assert heard.lost_share == pytest.approx(7 / 500, rel=0.02)
    assert heard.illegal == 1
    assert heard.ages.max() >= 0.007 - 1e-9


def test_without_samples_the_newest_gets_old():
    given = [Sample(0.0, 5, False, False, 0)]
    mute = SimpleNamespace(
        counts_per_rev=8, rejected=0, samples=lambda: [given.pop()] if given else []
    )
    heard = listen(mute, VirtualClock(), 0.1)
    assert heard.ages.max() == pytest.approx(0.1)
    assert heard.rate == 0.0
