"""`equipoise verify`: every kind of file, sound and damaged."""

import pytest

from equipoise.deployment import deploy
from tests.cli.damage import DAMAGE


@pytest.fixture
def files(tmp_path, pendulum_file, policy_file, small_policy, small_evaluation):
    """One file of each kind."""
    small_evaluation.save(tmp_path / "evaluation.json", command="test")
    deploy(small_policy, duration=0.5).save(tmp_path / "run.mcap", command="test")
    return tmp_path


HOLDS = {
    "pendulum.json": ("pendulum", "w2 = 70.2 1/s^2"),
    "policy.json": ("policy", "270 boxes by 8 actions for the iiwa14"),
    "evaluation.json": ("evaluation", "of 20 trials lasted 2 s on the iiwa14"),
    "run.mcap": ("run log", "of 0.5 s on the iiwa14, world model"),
}


@pytest.mark.parametrize("name", HOLDS)
def test_it_says_what_a_file_is_and_holds(equipoise, files, name):
    what, content = HOLDS[name]
    ran = equipoise("verify", name)
    assert ran.code == 0
    assert f"a sound {what} " in ran.out
    assert content in ran.out
    assert "digest  matches" in ran.out
    found = equipoise("verify", name, "--json").json
    assert found["what"] == what
    assert found["digest"].startswith("sha256:")
    assert found["provenance"]["command"] == "test"


@pytest.mark.parametrize("name", ["pendulum.json", "policy.json", "evaluation.json"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused(refused, files, name, damage):
    damage(files / name)
    refused("verify", name, saying=DAMAGE[damage])


def test_a_damaged_run_log_is_refused(refused, files):
    whole = (files / "run.mcap").read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:5], whole[:-40] + whole[-20:]):
        (files / "run.mcap").write_bytes(damaged)
        refused("verify", "run.mcap", saying="run.mcap")


def test_what_is_no_file_of_ours_is_refused(refused, swing, tmp_path):
    refused("verify", "nowhere.json", saying="there is no file nowhere.json")
    refused("verify", swing, saying="is not a file of Equipoise")
    refused("verify", tmp_path, saying="cannot read")
    refused("verify", saying="Missing argument")
