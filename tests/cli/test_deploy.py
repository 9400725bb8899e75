"""`equipoise deploy` and `identify` of a run log: from an excitation to an actuator."""

import sys

import pytest

from equipoise.errors import OutsideError
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import Actuator

pytestmark = pytest.mark.compiled_only


@pytest.fixture
def log(equipoise, tmp_path):
    assert equipoise("deploy", "--excite", "--out", "log.mcap").code == 0
    return tmp_path / "log.mcap"


def test_an_excitation_becomes_an_actuator_which_the_twin_has(equipoise, log, tmp_path):
    ran = equipoise("identify", log, "--json")
    assert ran.code == 0
    found = ran.json
    assert found["kind"] == "kst"
    assert found["delay"] == pytest.approx(0.010, abs=0.002)
    assert found["cycle"] == pytest.approx(0.001, rel=0.05)
    assert found["lags"] == pytest.approx([0.008] * 6, rel=0.2)
    assert Actuator.load(tmp_path / "actuator.json").delay.value == found["delay"]


def test_a_run_is_written_and_told_and_a_fall_is_exit_code_1(equipoise, policy_file, tmp_path):
    ran = equipoise("deploy", policy_file, "--duration", 5, "--seed", 2)
    run = RunLog.load(tmp_path / "run.mcap")
    assert run.conditions.world == "twin:nominal"
    assert ran.code == (0 if run.outcome == "lasted" else 1)
    assert "encoder's zero" in ran.out
    assert f"ended: {run.outcome}" in ran.out


def test_what_does_not_go_together_is_refused(refused, policy_file, tmp_path):
    refused("deploy", policy_file, "--excite", saying="POLICY does not go with --excite")
    refused("deploy", policy_file, "--arm", "iiwa7", saying="was trained on the iiwa14")
    refused("deploy", "--excite", "--world", "model", saying="is no digital twin")
    refused(
        "deploy", policy_file, "--world", "twin:nominel", saying="there is no world 'twin:nominel'"
    )
    refused("deploy", policy_file, "--out", "run.json", saying="ends in .mcap")
    refused("deploy", policy_file, "--video", "run.gif", saying="ends in .mp4")
    refused("deploy", policy_file, "--duration", 0, saying="from 0.01 to 3600")
    refused("deploy", tmp_path / "none.json", saying="there is no file")


def test_a_film_that_cannot_be_encoded_is_refused_before_the_run(refused, monkeypatch, log):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refused("deploy", "--video", "run.mp4", saying="needs the package imageio-ffmpeg")
    refused("log", "export", log, "--video", "run.mp4", saying="needs the package imageio-ffmpeg")
    assert not list(log.parent.glob("run*"))


def test_a_film_that_fails_leaves_the_log(equipoise, monkeypatch, tmp_path):
    def full(*_, **__):
        raise OutsideError("the disk is full")

    monkeypatch.setattr("equipoise.film.write_film", full)
    ran = equipoise("deploy", "--world", "model", "--duration", 0.2, "--video", "run.mp4")
    assert ran.code == 3
    assert {path.name for path in tmp_path.glob("run*")} == {"run.mcap"}


def test_options_of_a_swing_are_refused_for_a_run_log(refused, log):
    refused("identify", log, "--friction", "coulomb", saying="does not go with a run log")


def test_a_log_of_a_run_that_moves_too_little_is_refused(refused, equipoise, policy_file, tmp_path):
    equipoise("deploy", policy_file, "--duration", 0.2, "--out", "short.mcap")
    refused("identify", tmp_path / "short.mcap", saying="expected at least")


def test_an_empty_log_is_refused_and_of_a_cut_one_the_sound_part_is_used(refused, equipoise, log):
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) * 2 // 3])
    ran = equipoise("identify", log)
    assert ran.code == 0
    assert "warning: the log is cut short" in " ".join(ran.out.split())
    log.write_bytes(b"")
    refused("identify", log, saying="log.mcap")


def test_a_run_log_is_no_actuator_and_an_actuator_no_policy(refused, equipoise, log, tmp_path):
    refused("train", "--actuator", log, saying="expected an actuator")
    equipoise("identify", log)
    refused("deploy", tmp_path / "actuator.json", saying="equipoise-policy")
