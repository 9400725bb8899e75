"""`equipoise deploy --robot`: the course as a user sees it."""

import pytest

from equipoise.runwriter import read_rig_run

pytestmark = pytest.mark.compiled_only


def test_a_run_on_a_twin_is_told_and_written(equipoise, tmp_path):
    ran = equipoise("deploy", "--robot", "twin:nominal", "--duration", 1, "--json")
    assert ran.code == 0, ran
    assert ran.json["cause"] == "lasted"
    assert ran.json["lasted"] == 1.0
    # Whoever stands there is told, though a program reads the result.
    assert "no watchdog" in ran.err
    assert "Moving to home" in ran.err
    assert read_rig_run(tmp_path / "run.mcap").end["cause"] == "lasted"


def test_a_dry_run_ends_before_the_arm_moves(equipoise):
    ran = equipoise("deploy", "--robot", "twin:nominal", "--dry-run")
    assert ran.code == 0, ran
    assert "good" in ran.out
    assert "no watchdog" in ran.out
    assert "Moving to home" not in ran.out


def test_what_does_not_go_together_is_refused(refused, tmp_path):
    refused("deploy", "--dry-run", saying="give --robot")
    refused("deploy", "--t1", saying="give --robot")
    refused("deploy", "--robot", "kst://host", saying="give --encoder")
    refused("deploy", "--robot", "host", saying="is no address of a robot")
    refused("deploy", "--robot", "twin:nominal", "--excite", saying="do not go with --robot")
    refused("deploy", "--robot", "twin:nominal", "--rig", "none.toml", saying="cannot read")
    (tmp_path / "rig.toml").write_text("arm = 'iiwa7'\n")
    refused("deploy", "--rig", "rig.toml", saying="give --robot")


def test_a_policy_for_another_arm_is_refused(equipoise, policy_file):
    ran = equipoise("deploy", policy_file, "--robot", "twin:nominal")
    assert ran.code == 2
    assert "trained on iiwa14, the rig has iiwa7" in ran.err
