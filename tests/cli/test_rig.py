"""Verbs of the rig, on emulated devices in virtual time."""

import os
import signal
import time

import pytest

from equipoise import Actuator, RunLog, shipped_policy
from equipoise.rig import clocks
from equipoise.robots.kst.robot import KstRobot
from tests.cli.conftest import contents
from tests.robots.encoder.by_hand import RELEASE, ByHand
from tests.robots.encoder.rig import Bench

URI = "serial:///dev/ttyACM0"


@pytest.mark.full
def test_a_run_on_a_twin_is_told_and_written(equipoise, tmp_path):
    ran = equipoise("deploy", "--robot", "twin:nominal", "--duration", 1, "--json")
    assert ran.json["survival_s"] == 1.0
    # The operator is notified, although a program reads the result.
    assert "Moving to home" in ran.err
    log = RunLog.load(tmp_path / "run.mcap", damaged=True)
    assert log.survival == 1.0


def test_a_dry_run_ends_before_the_arm_moves_and_names_the_run_itself(equipoise):
    options = ("--arm", "iiwa14", "--max-speed", 0.23, "--duration", 5)
    ran = equipoise("deploy", "lqr", "--robot", "twin:nominal", "--dry-run", *options)
    assert "Moving to home" not in ran.out
    again = "deploy lqr --duration 5.0 --robot twin:nominal --max-speed 0.23 --arm iiwa14"
    assert ran.out.endswith(f"next: equipoise {again}\n")


@pytest.mark.full
def test_an_arm_that_fits_no_policy_leads_to_a_training_for_it(equipoise, pendulum, tmp_path):
    slow, shipped = Actuator.assumed("kst", delay=0.05, lag=0.008), shipped_policy()
    worst = tuple(tuple(-value for value in row) for row in shipped.Q)
    new = {"pendulum": pendulum, "actuator": slow, "Q": worst}
    shipped.model_copy(update=new).save(tmp_path / "slow.json", command="test")
    pendulum.save(tmp_path / "my-pendulum.json", command="test")
    options = ("--arm", "iiwa7", "--identify")
    ran = equipoise("deploy", "slow.json", "--robot", "twin:nominal", *options, code=1)
    assert "arm not identified" in ran.out, ran
    then = "train my-pendulum.json --arm iiwa7 --actuator run-actuator.json"
    assert ran.out.endswith(f"next: equipoise {then}\n")


def test_a_driver_that_sleeps_ends_a_run_on_a_twin(equipoise, monkeypatch):
    monkeypatch.setattr(clocks, "DEVICE_TIMEOUT", 0.5)
    monkeypatch.setattr(KstRobot, "_wait", lambda robot, duration: time.sleep(1e-3))
    ran = equipoise("deploy", "--robot", "twin:nominal", code=3)
    assert "KstRobot.connect has waited for 0.5 s" in ran.err


@pytest.mark.parametrize(
    ("verb", "stage"),
    [
        ("deploy", "simulate_run"),
        ("rig doctor", "rig.checks.examine"),
        ("train", "train_to_target"),
        ("evaluate", "evaluate"),
        ("reproduce", "reproduce"),
        ("warm-up", "reproduction.warm_up.warm_up"),
    ],
)
def test_a_signal_ends_a_verb_with_its_exit_code(equipoise, monkeypatch, verb, stage):
    def wait(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60.0)

    monkeypatch.setattr(f"equipoise.{stage}", wait)
    assert "interrupted" in equipoise(*verb.split(), code=130).err


def test_doctor_examines_this_machine(equipoise, monkeypatch):
    # The settings of a loop would stay with the process of the tests.
    monkeypatch.setattr("equipoise.rig.checks.prepare", dict)
    ran = equipoise("rig", "doctor", "--seconds", 0.2, "--json", code=None)
    assert ran.code == int(ran.json["verdict"] == "not fit")
    assert ran.json["findings"]
    assert "verdict" in equipoise("rig", "doctor", "--seconds", 0.2, code=None).out


@pytest.fixture
def bench(monkeypatch):
    """A board at `URI`; the machine's clock is the bench's."""
    bench = Bench()
    bench.motion = ByHand(0.8)
    monkeypatch.setattr("equipoise.rig.clocks.SystemClock", lambda: bench.clock)
    monkeypatch.setattr("equipoise.robots.encoder.plugin.open_serial", lambda uri: bench.open())
    return bench


def test_a_swing_becomes_a_file_that_identify_reads(equipoise, bench):
    ran = equipoise("rig", "record", "--encoder", URI, "--duration", 8, "--json")
    assert (ran.json["missing"], ran.json["counts_per_rev"]) == (0, 8192)
    found = equipoise("identify", "swing.csv", "--json").json
    assert found["w2"]["value"] == pytest.approx(70.2, rel=0.01)


@pytest.mark.parametrize("end", ["interrupted", "unplugged"])
def test_a_recording_that_ends_early_keeps_nothing(equipoise, bench, tmp_path, end):
    def fail(now):
        if now > RELEASE + 2.0:
            if end == "interrupted":
                raise KeyboardInterrupt
            if bench.device is not None:
                bench.unplug()

    bench.clock.attach(fail)
    code = 130 if end == "interrupted" else 3
    equipoise("rig", "record", "--encoder", URI, code=code)
    assert contents(tmp_path) == {}
