"""`equipoise map`: what it says, what it leaves, and what it refuses."""

import pytest

from equipoise.studies.recovery_map import RecoveryMap
from tests.cli.damage import DAMAGE

FEW = ("--starts", 16, "--duration", 0.5)


def test_a_map_is_left_with_its_figure(equipoise, tmp_path):
    ran = equipoise("map", *FEW)
    assert ran.code == 0, ran
    found = RecoveryMap.load(tmp_path / "map.json")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "map.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert "wrote map.json, map.svg and map.png" in ran.out
    inside = found.slices[0].held_share("necessary")
    said = " ".join(ran.out.split())
    assert f"{inside.held} of {inside.starts} starts, {100.0 * inside.share:.1f} %" in said
    assert f"phi + phi_dot / {found.fade:.1f} of" in said
    assert "2 m/s^2 on a track of 0.22 m" in said
    assert "1.5 to 2.5 deg, 8 to 18 deg/s: 100 % recoverable" in said
    assert "next: equipoise evaluate --world model" in ran.out


@pytest.mark.slow
def test_json_is_one_object(equipoise):
    found = equipoise("map", "lqr", *FEW, "--out", "mine.json", "--json").json
    assert found["files"] == ["mine.json", "mine.svg", "mine.png"]
    assert found["releases_recoverable"] == 1.0
    assert 0.4 < found["release_use"] < 0.6
    first, second = found["slices"]
    assert (first["plane"], second["plane"]) == ("pendulum", "flange")
    low, high = first["necessary_interval"]
    assert low <= first["necessary"]["share"] <= high
    assert first["outside"]["held"] == 0


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_policy_is_refused(refused, policy_file, damage):
    damage(policy_file)
    refused("map", policy_file, saying=DAMAGE[damage])


OPTIONS = {
    "unknown world": (("--world", "mars"), "there is no world 'mars'"),
    "no starts": (("--starts", "0"), "--starts"),
    "a billion starts": (("--starts", 10**9), "1,000,000"),
    "no duration": (("--duration", "0"), "--duration is 0.0 s"),
    "an endless duration": (("--duration", "inf"), "--duration is inf s"),
    "no actuator": (("--actuator", "policy.json"), "expected 'equipoise-actuator'"),
    "output is no JSON": (("--out", "map.png"), "ends in .json"),
    "output is the policy": (("--out", "policy.json"), "would be written over"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, policy_file, flaw):
    options, saying = OPTIONS[flaw]
    refused("map", policy_file, *options, saying=saying)
