"""`equipoise refine`: what it says of a model, what it writes, and what it refuses."""

import os
import sys

import pytest

from equipoise.artefacts import Estimate
from equipoise.cli.output import measured
from equipoise.control.policy import TabularPolicy, shipped_policy
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import TwinSettings, World
from equipoise.rig.simulate import simulate_run
from tests.cli.conftest import contents

# Runs of twelve seconds are 12,000 steps of the physics engine.
pytestmark = pytest.mark.compiled_only

STABLE = {
    "moved",
    "w2",
    "w2_interval",
    "k",
    "k_interval",
    "c",
    "c_interval",
    "delay",
    "delay_interval",
    "kept",
    "survival",
    "warnings",
    "policy",
    "pendulum",
    "actuator",
}


@pytest.fixture(scope="session")
def run():
    """A run of the shipped policy on a twin whose pendulum is as the policy believes."""
    twin = TwinSettings(inertia_sigma=0.0, friction_sigma=0.0)
    return simulate_run(shipped_policy(), world=World("twin:steady", twin), seed=2, duration=12.0)


@pytest.fixture
def run_file(run, tmp_path):
    path = tmp_path / "run.mcap"
    run.save(path, command="test")
    return path


def saved(policy, tmp_path, factor):
    """Write a policy that believes w2 to be another by a factor; return its path."""
    w2, k = policy.pendulum.w2.value * factor, policy.pendulum.k.value * factor
    known = {
        name: Estimate(value=value, low=value, high=value, source="given")
        for name, value in (("w2", w2), ("k", k))
    }
    pendulum = policy.pendulum.model_copy(update=known)
    path = tmp_path / "policy.json"
    actuator = Actuator.assumed("kst", delay=0.010, lag=0.008)
    changes = {"pendulum": pendulum, "actuators": (actuator,)}
    policy.model_copy(update=changes).save(path, command="test")
    return path


@pytest.fixture
def policy_file(tmp_path, quick_settings):
    """The shipped policy, with the settings of a quick training."""
    policy = shipped_policy().model_copy(update={"settings": quick_settings})
    return saved(policy, tmp_path, 1.0)


@pytest.fixture
def mistaken_file(tmp_path, quick_settings):
    """The same, taking w2 to be ten percent less than it is."""
    policy = shipped_policy().model_copy(update={"settings": quick_settings})
    return saved(policy, tmp_path, 1.0 / 1.1)


def test_a_model_that_still_holds_is_left_alone(equipoise, policy_file, run_file, tmp_path):
    before = contents(tmp_path)
    ran = equipoise("refine", policy_file, run_file)
    assert ran.code == 0, ran
    assert "The model still holds" in ran.out
    assert "lag of A1" in ran.out
    assert "wrote" not in ran.out
    assert ran.out.endswith(f"next: equipoise deploy {policy_file}\n")
    assert contents(tmp_path) == before


def test_what_moved_is_said_and_written_with_the_better_policy(
    equipoise, mistaken_file, run_file, tmp_path
):
    if sys.platform == "linux":  # a name that is not UTF-8 comes into the provenance, too
        run_file = run_file.rename(tmp_path / os.fsdecode(b"r\xffn.mcap"))
    ran = equipoise("refine", mistaken_file, run_file, "--episodes", 40, "--workers", 1)
    assert ran.code == 0, ran
    assert "w2 moved by +" in ran.out
    assert "table is kept" in ran.out
    assert "wrote refined-pendulum.json and refined.json" in ran.out
    assert ran.out.endswith("next: equipoise evaluate refined.json\n")
    pendulum = Pendulum.load(tmp_path / "refined-pendulum.json")
    truth = RunLog.load(run_file).conditions.pendulum["w2"]
    assert pendulum.w2.value == pytest.approx(truth, rel=0.01)
    assert TabularPolicy.load(tmp_path / "refined.json").pendulum == pendulum
    assert not (tmp_path / "refined-actuator.json").exists()


def test_json_is_one_object_with_the_stable_keys(equipoise, mistaken_file, run_file):
    ran = equipoise("refine", mistaken_file, run_file, "--no-train", "--json")
    assert ran.code == 0, ran
    assert ran.err == ""
    found = ran.json
    assert found.keys() >= STABLE
    assert found["moved"] == ["w2"]
    low, high = found["w2_interval"]
    assert low < found["w2"] < high
    assert found["delay"] == pytest.approx(0.010, abs=0.001)
    assert (found["pendulum"], found["policy"]) == ("refined-pendulum.json", None)
    assert (found["kept"], found["survival"]) == (None, {})


def test_asked_to_it_trains_on_where_nothing_moved(equipoise, policy_file, run_file, tmp_path):
    options = ("--always", "--episodes", 40, "--out", "more.json", "--json")
    found = equipoise("refine", policy_file, run_file, *options).json
    assert (found["moved"], found["pendulum"], found["actuator"]) == ([], None, None)
    assert found["kept"] in ("old", "new")
    assert found["survival"].keys() == found["score"].keys() == {"old", "new"}
    assert found["score"][found["kept"]] == max(found["score"].values())
    more, policy = TabularPolicy.load(tmp_path / "more.json"), TabularPolicy.load(policy_file)
    assert (more.pendulum, more.actuator) == (policy.pendulum, policy.actuator)


def test_what_cannot_be_compared_is_refused(refused, policy_file, run_file, small_policy, tmp_path):
    refused("refine", policy_file, "nowhere.mcap", saying="there is no file nowhere.mcap")
    refused("refine", policy_file, policy_file, saying="is not an MCAP file")
    refused("refine", run_file, run_file, saying="not a file of Equipoise")
    refused("refine", policy_file, run_file, "--out=run.mcap", saying="ends in .json")
    refused("refine", policy_file, run_file, "--out=policy.json", saying="give another --out")
    simulate_run(shipped_policy(), duration=0.1).save(tmp_path / "model.mcap", command="test")
    refused("refine", policy_file, "model.mcap", saying="expected a run on a rig")
    simulate_run(small_policy, duration=0.1).save(tmp_path / "other.mcap", command="test")
    refused("refine", policy_file, "other.mcap", saying="was on an iiwa14")
    run_file.write_bytes(run_file.read_bytes()[:200])
    refused("refine", policy_file, run_file, saying="run.mcap")


@pytest.mark.parametrize(
    ("estimate", "words"),
    [
        ((-0.05, -0.12, 0.02), "not distinguishable from 0 1/s  (95 %: below 0.02)"),
        ((0.0, 0.0, 0.03), "not distinguishable from 0 1/s  (95 %: below 0.03)"),
        ((0.02, -0.01, 0.05), "0.020 1/s  (95 %: 0 to 0.050)"),
        ((0.15, 0.13, 0.17), "0.150 1/s  (95 %: 0.130 to 0.170)"),
        ((-0.5, -0.6, -0.4), "-0.5 1/s, which cannot be: the model does not fit"),
    ],
)
def test_no_quantity_that_cannot_be_negative_is_printed_so(estimate, words):
    value, low, high = estimate
    told = Estimate(value=value, low=low, high=high, source="identified")
    assert measured(told, "1/s") == words
    assert min(told.not_negative().interval) >= 0.0
