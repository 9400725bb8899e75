"""`equipoise train`: what it writes and prints, what it refuses, and how it is stopped."""

import re
from pathlib import Path

import pytest

from equipoise.control.policy import TabularPolicy
from equipoise.learning import target as target_module
from equipoise.model.actuator import Actuator
from tests.cli.conftest import contents
from tests.cli.damage import DAMAGE

URDF = Path(__file__).parents[1] / "data" / "elbow6.urdf"

SHORT = (
    "--episodes=40",
    "--workers=1",
    "--set=learning.episode_duration=1",
    "--set=selection.every=20",
    "--set=selection.round_trials=4",
    "--set=selection.duration=4",
    "--set=selection.test_trials=100",
)
FEW = ("--target=0.9", "--learners=3")


def test_it_writes_a_policy_and_names_the_next_command(equipoise, pendulum_file, tmp_path):
    ran = equipoise("train", pendulum_file, *SHORT, "--target=0")
    assert ran.code == 0
    policy = TabularPolicy.load(tmp_path / "policy.json")
    assert (policy.arm.name, policy.episodes) == ("iiwa7", 40)
    assert policy.recipe.startswith("custom: robust with learning.episodes = 40, ")
    assert policy.learning_curve
    assert "40 episodes" in ran.out
    assert f"{policy.test.survived} of 64 trials lasted 4 s" in ran.out
    assert ran.out.endswith("next: equipoise evaluate policy.json\n")


def test_a_policy_that_misses_the_target_is_written_and_marked(equipoise, pendulum_file, tmp_path):
    ran = equipoise("train", pendulum_file, *SHORT, *FEW)
    assert ran.code == 1
    policy = TabularPolicy.load(tmp_path / "policy.json")
    assert not policy.test.met
    assert "None of 3 learners meets the target." in ran.out
    # It says by which causes the trials ended, and what helps.
    for cause, count in policy.test.failures.items():
        assert f"{cause} {count}" in ran.out
        assert f"{cause}: " in ran.out
    assert ran.out.endswith("next: equipoise evaluate policy.json\n")
    # Each verb that uses the policy says so in one line.
    line = f"warning: {policy.shortfall}"
    few = ("--trials", 4, "--duration", 1, "--no-baselines")
    for verb in (("evaluate", "policy.json", *few), ("deploy", "policy.json", "--duration", 1)):
        assert line in " ".join(equipoise(*verb).out.split())


def test_the_line_of_the_learners_counts_those_that_were_needed(
    equipoise, pendulum_file, monkeypatch
):
    original = target_module.measure_policy

    def tested(policy, **given):
        (test,) = original(policy, **given)
        return (test.model_copy(update={"met": policy.learner >= 2}),)

    monkeypatch.setattr(target_module, "measure_policy", tested)
    ran = equipoise("train", pendulum_file, *SHORT, "--target=0.9", "--learners=50")
    assert ran.code == 0
    assert re.search(r"learners +\d+\.\d s  3 learners$", ran.err, re.MULTILINE)
    assert re.search(r"learners +1 of 3 meet the target", ran.out)


def test_the_first_learner_that_meets_the_target_ends_the_training(equipoise, pendulum_file):
    ran = equipoise("train", pendulum_file, *SHORT, "--set=selection.duration=0.05", *FEW, "--json")
    assert ran.code == 0
    assert (ran.json["met"], ran.json["learner"], len(ran.json["learners"])) == (True, 0, 1)
    assert ran.json["interval"][0] >= ran.json["target"] == 0.9


def test_json_is_one_object_with_the_stable_keys(equipoise, pendulum_file):
    ran = equipoise("train", pendulum_file, *SHORT, *FEW, "--seed", 3, "--json")
    assert ran.code == 1
    stable = {"policy", "seed", "episodes", "steps", "wall_s"}
    stable |= {"target", "met", "trials", "survived", "interval", "causes"}
    assert stable <= ran.json.keys()
    assert not ran.json["met"]
    assert sum(ran.json["causes"].values()) == ran.json["trials"]
    assert (ran.json["policy"], ran.json["seed"], ran.json["episodes"]) == ("policy.json", 3, 40)
    assert ran.json["steps"] > 40
    assert ran.err == ""


def test_equal_seeds_give_equal_policies_whatever_the_workers(equipoise, pendulum_file, tmp_path):
    for name, workers in (("one.json", 1), ("two.json", 2)):
        options = (*SHORT, *FEW, "--workers", workers, "--out", name)
        assert equipoise("train", pendulum_file, *options).code == 1
    one, two = (TabularPolicy.load(tmp_path / name) for name in ("one.json", "two.json"))
    assert one.digest == two.digest


def test_the_best_of_several_learners_is_kept(equipoise, pendulum_file):
    found = equipoise("train", pendulum_file, *SHORT, *FEW, "--json").json
    lows = {each["learner"]: each["test"]["interval"][0] for each in found["learners"]}
    assert set(lows) == {0, 1, 2}
    assert lows[found["learner"]] == max(lows.values())


def test_recipe_settings_and_single_settings_are_recorded_in_their_order(
    equipoise, pendulum_file, tmp_path
):
    (tmp_path / "mine.toml").write_text("[learning]\ngamma = 0.9\nalpha_initial = 0.5\n")
    options = ("--recipe=paper", "--settings=mine.toml", "--set=learning.gamma=0.95")
    assert equipoise("train", pendulum_file, *SHORT, "--target=0", *options).code == 0
    policy = TabularPolicy.load(tmp_path / "policy.json")
    assert policy.recipe.startswith("custom: paper with ")
    assert policy.settings.learning.mirrored is False  # the recipe's
    assert policy.settings.learning.alpha_initial == 0.5  # the file's, over the recipe's
    assert policy.settings.learning.gamma == 0.95  # the single setting's, over the file's


def test_an_arm_from_a_urdf_is_trained(equipoise, pendulum_file, tmp_path):
    ran = equipoise("train", pendulum_file, *SHORT, "--target=0", "--arm", URDF)
    assert ran.code == 0, ran
    assert TabularPolicy.load(tmp_path / "policy.json").arm.name == "elbow 6"


def test_a_guest_s_learner_and_reward_train_a_policy(equipoise, pendulum_file, tmp_path):
    (tmp_path / "own_rules.py").write_text(
        "from equipoise.learning.learner import Learner, move_towards\n"
        "def reward(state, u, next_state, failed):\n"
        "    return -1.0 if failed else -0.1 * abs(next_state.phi)\n"
        "def update(tables, transition, params):\n"
        "    move_towards(tables, transition.box, transition.action, transition.reward, params)\n"
        "learner = Learner(update)\n"
    )
    guests = ("--reward=own_rules:reward", "--learner=own_rules.py:learner")
    ran = equipoise("train", pendulum_file, *SHORT, "--target=0", *guests)
    assert ran.code == 0, ran
    policy = TabularPolicy.load(tmp_path / "policy.json")
    assert policy.settings.learning.reward.startswith("own_rules:reward@")
    assert "learning.reward = own_rules:reward@" in policy.recipe
    assert equipoise("train", pendulum_file, *SHORT, "--target=0", "--out=ours.json").code == 0
    assert TabularPolicy.load(tmp_path / "ours.json").Q != policy.Q


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_pendulum_is_refused(refused, pendulum_file, damage):
    damage(pendulum_file)
    refused("train", pendulum_file, saying=DAMAGE[damage])


def test_what_is_no_pendulum_is_refused(refused, swing, policy_file):
    refused("train", "nowhere.json", saying="there is no file nowhere.json")
    refused("train", swing, saying="make one of it: equipoise identify")
    saying = "holds 'equipoise-policy', expected 'equipoise-pendulum'"
    refused("train", policy_file, "--out", "other.json", saying=saying)


OPTIONS = {
    "unknown recipe": (("--recipe", "magic"), "there is no recipe 'magic'"),
    "unknown arm": (("--arm", "iiwa8"), "there is no arm 'iiwa8'"),
    "unknown setting": (("--set", "learning.gama=0.9"), "there is no setting 'learning.gama'"),
    "impossible setting": (("--set", "learning.gamma=1.5"), "setting learning.gamma"),
    "setting of another kind": (("--set", "learning.gamma=high"), "setting learning.gamma"),
    "unknown learner": (("--learner", "sarza"), "unknown learner"),
    "unknown reward": (("--reward", "none"), "unknown reward"),
    "reward of no module": (("--reward", "nowhere:reward"), "there is no module 'nowhere'"),
    "no episodes": (("--episodes", "0"), "--episodes"),
    "half an episode": (("--episodes", "0.5"), "--episodes"),
    "no learners": (("--learners", "0"), "--learners"),
    "target above all": (("--target", "1.5"), "--target is 1.5; give a number from 0 to 1"),
    "target beyond the test": (
        ("--target", "0.9999"),
        "4,000 trials cannot show a share of 0.9999",
    ),
    "negative seed": (("--seed", "-1"), "--seed"),
    "seed of no size": (("--seed", str(2**70)), "--seed"),
    "no workers": (("--workers", "0"), "--workers"),
    "held joint of an iiwa": (("--held", "3"), "held belong to an arm from a URDF"),
    "missing URDF": (("--arm", "nowhere.urdf"), "there is no file nowhere.urdf"),
    "unknown held joint": (("--arm", URDF, "--held", "wrist"), "has no joint wrist to hold"),
    "held joint of a six-joint arm": (
        ("--arm", URDF, "--held", "2"),
        "5 free joints, expected six",
    ),
    "unknown base": (("--arm", URDF, "--base", "table"), "has no link table"),
    "unknown tip": (("--arm", URDF, "--tip", "hand"), "has no link hand"),
    "tip before the sixth joint": (("--arm", URDF, "--tip", "wrist_1"), "expected six"),
    "output is a folder": (("--out", "."), "give a name that ends in .json"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, pendulum_file, flaw):
    options, saying = OPTIONS[flaw]
    refused("train", pendulum_file, *options, saying=saying)


URDFS = {
    "not XML": ("robot", "is not a URDF"),
    "another XML": ("<model/>", "is not a URDF"),
    "no links": ('<robot name="none"/>', "arm.urdf"),
}


@pytest.mark.parametrize("flaw", URDFS)
def test_a_urdf_that_is_none_is_refused(refused, pendulum_file, tmp_path, flaw):
    text, saying = URDFS[flaw]
    (tmp_path / "arm.urdf").write_text(text)
    refused("train", pendulum_file, "--arm", "arm.urdf", saying=saying)


def test_the_pendulum_is_not_written_over(refused, pendulum_file):
    refused("train", pendulum_file, "--out", "pendulum.json", saying="would be written over")


def test_a_full_disk_is_the_outside_world(equipoise, pendulum_file, monkeypatch, tmp_path):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    before = contents(tmp_path)
    monkeypatch.setattr("os.fsync", full)
    ran = equipoise("train", pendulum_file, *SHORT, "--target=0")
    assert ran.code == 3
    assert ran.err.endswith("error: cannot write policy.json: No space left on device\n")
    assert contents(tmp_path) == before


def test_each_stage_is_one_line_where_there_is_no_terminal(equipoise, pendulum_file):
    ran = equipoise("train", pendulum_file, *SHORT, *FEW)
    stages = ["compile", "train", "select", "test", "learners"]
    assert [line.split()[0] for line in ran.err.splitlines()] == stages
    assert re.search(r"train +\d+\.\d s  40 episodes$", ran.err, re.MULTILINE)
    assert re.search(r"learners +\d+\.\d s  3 learners$", ran.err, re.MULTILINE)


def test_a_limited_speed_is_in_the_policy_and_in_its_evaluation(equipoise, pendulum_file, tmp_path):
    ran = equipoise("train", pendulum_file, *SHORT, "--target=0", "--max-speed", 0.23)
    assert ran.code == 0, ran
    assert "below 0.23 m/s" in ran.out
    settings = TabularPolicy.load(tmp_path / "policy.json").settings
    assert settings.plant.max_speed == 0.23
    few = ("--trials", 4, "--duration", 1, "--no-baselines")
    assert "flange below 0.23 m/s" in equipoise("evaluate", "policy.json", *few).out
    # At a crawl no trial lasts, whatever the policy was trained for.
    slow = equipoise("evaluate", "policy.json", *few, "--max-speed", 0.02, "--json")
    assert slow.code == 1
    assert slow.json["causes"] == {"flange speed": 4}


def test_an_impossible_limit_of_the_speed_is_refused(refused):
    refused("train", "--max-speed", -1, saying="plant.max_speed")
    refused(
        "train", "--recipe", "paper", "--max-speed", 0.23, saying="--max-speed needs a selection"
    )
    refused("evaluate", "--max-speed", 5, saying="give a number from 0.01 to 2")


def test_a_pendulum_that_no_controller_balances_is_refused(refused, tmp_path):
    late = Actuator.assumed("lag", delay=0.25, lag=0.01)
    late.save(tmp_path / "actuator.json", command="test")
    saying = "no controller balances this pendulum: phi + phi_dot / 8.5 is"
    refused("train", "--actuator", "actuator.json", saying=saying)
