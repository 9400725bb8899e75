"""The last line of each verb: a command that parses, fits what came of it, and keeps the options.

Every command that any test of the command line prints is parsed, too: see `equipoise` in conftest.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from equipoise.cli import next_step
from equipoise.control.bound_policy import load_policy
from equipoise.control.policy import TargetTest, shipped_policy
from equipoise.model.actuator import Actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum
from tests.cli.conftest import parse

OTHER = shipped_policy().model_copy(update={"pendulum": Pendulum.assumed(120.0, 0.2)})
LQR = load_policy("lqr")
LARGE = OTHER.model_copy(update={"arm": iiwa(14)})
LIMITED = OTHER.settings.plant.model_copy(update={"max_speed": 0.23})
SLOW = OTHER.model_copy(update={"settings": OTHER.settings.model_copy(update={"plant": LIMITED})})
MINE = Path("my policy.json")
TOML = "twin:my world.toml"


def given_words(command):
    return [str(word) for word in command if word is not None]


def evaluated(balanced, policy=OTHER, path=MINE, **given):
    given = {"world": "model", **given}
    return next_step.after_evaluation(balanced, policy, path, **given)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (lambda: evaluated(True), "evaluate|my policy.json|--world|twin:nominal"),
        (lambda: evaluated(True, path=None), "evaluate|--world|twin:nominal"),
        (
            lambda: evaluated(True, actuator="a.json", max_speed=0.23),
            "evaluate|my policy.json|--world|twin:nominal|--actuator|a.json|--max-speed|0.23",
        ),
        (lambda: evaluated(True, world=TOML), f"deploy|my policy.json|--world|{TOML}"),
        (
            lambda: evaluated(True, world="twin:harsh", actuator="a.json"),
            "deploy|my policy.json|--world|twin:harsh|--actuator|a.json",
        ),
        # One that does not balance is not deployed.
        (lambda: evaluated(False, pendulum=Path("p.json")), "train|p.json|--learners|12"),
        (lambda: evaluated(False), "train|PENDULUM|--learners|12"),
        (lambda: evaluated(False, shipped_policy(), None), "train|--learners|12"),
        (lambda: evaluated(False, world="twin:nominal"), "train|PENDULUM|--learners|12"),
        (lambda: evaluated(False, LARGE), "train|PENDULUM|--arm|iiwa14|--learners|12"),
        (lambda: evaluated(False, SLOW), "train|PENDULUM|--max-speed|0.23|--learners|12"),
        (
            lambda: evaluated(False, world=TOML, actuator="a.json"),
            "train|PENDULUM|--actuator|a.json|--learners|12",
        ),
        # In a world of its own the arm is identified first.
        (
            lambda: evaluated(False, LARGE, world=TOML),
            f"deploy|--excite|--world|{TOML}|--arm|iiwa14|--out|excitation.mcap",
        ),
        # A policy that is no table keeps its task.
        (
            lambda: next_step.after_evaluation(
                True, LQR, Path("lqr"), "--pendulum", "p.json", world="ideal"
            ),
            "evaluate|lqr|--world|twin:nominal|--pendulum|p.json",
        ),
        (
            lambda: next_step.after_evaluation(
                True, LQR, Path("lqr"), "--pendulum", "p.json", world="twin:harsh"
            ),
            "deploy|lqr|--world|twin:harsh|--pendulum|p.json",
        ),
        (
            lambda: next_step.after_evaluation(False, LQR, Path("lqr"), world="ideal"),
            "train|--learners|12",
        ),
        # Drift.
        (
            lambda: next_step.after_refinement(
                True, Path("r.json"), MINE, [Path("1.mcap")], [TOML]
            ),
            "evaluate|r.json|--world|twin:nominal",  # that file is gone
        ),
        (
            lambda: next_step.after_refinement(
                True, Path("r.json"), MINE, [Path("1.mcap")], ["twin:harsh"]
            ),
            "evaluate|r.json|--world|twin:harsh",
        ),
        (
            lambda: next_step.after_refinement(
                True, Path("r.json"), MINE, [Path("1.mcap")], ["kst://10.0.0.1:30001"]
            ),
            "evaluate|r.json|--world|twin:nominal",
        ),
        (
            lambda: next_step.after_refinement(
                True, None, MINE, [Path("1.mcap"), Path("2.mcap")], ["twin:nominal"] * 2
            ),
            "refine|my policy.json|1.mcap|2.mcap",
        ),
        (
            lambda: next_step.after_refinement(
                False, None, MINE, [Path("1.mcap")], ["kst://10.0.0.1"]
            ),
            "deploy|my policy.json|--robot|kst://10.0.0.1|--encoder|serial:///dev/ttyACM0",
        ),
        # Logs.
        (
            lambda: next_step.after_explanation(
                Path("r.mcap"), shipped_policy().digest, moved=True
            ),
            "log|replay|r.mcap",
        ),
        (
            lambda: next_step.after_explanation(Path("r.mcap"), "sha256:0", moved=True),
            "log|export|r.mcap",
        ),
        (
            lambda: next_step.after_explanation(Path("r.mcap"), "sha256:0", moved=False),
            "rig|doctor",
        ),
        (lambda: next_step.after_explanation(Path("r.mcap"), "", moved=False), "identify|r.mcap"),
    ],
)
def test_the_next_command_fits_and_keeps_what_was_given(command, words):
    given = given_words(command())  # reads the current folder: not while tests are collected
    assert "|".join(given) == words
    parse(given)


@pytest.mark.parametrize(
    ("met", "words"),
    [
        (True, "evaluate|policy.json"),
        (False, "train|p.json|--arm|iiwa14|--set|learning.episodes=10|--learners|12"),
    ],
)
def test_a_policy_that_misses_its_target_is_trained_again_with_more_learners(met, words):
    test = TargetTest(
        target=0.99,
        met=met,
        duration=60.0,
        trials=64,
        survived=60,
        interval=(0.8, 0.98),
        causes={"lasted": 60, "track": 4},
    )
    policy = shipped_policy().model_copy(update={"tests": (test,)})
    again = ["p.json", "--arm", "iiwa14", "--set", "learning.episodes=10"]
    command = next_step.after_training(Path("policy.json"), policy, again, 6)
    assert "|".join(given_words(command)) == words
    parse(given_words(command))


@pytest.mark.parametrize(
    ("cause", "words"),
    [
        ("lasted", f"evaluate|my policy.json|--world|{TOML}|--actuator|a.json"),
        ("guard", "log|explain|run-2.mcap"),
        ("angle", "log|explain|run-2.mcap"),
    ],
)
def test_a_run_that_failed_is_explained(cause, words):
    run = SimpleNamespace(cause=cause)
    command = next_step.after_run(run, Path("run-2.mcap"), MINE, "--actuator", "a.json", world=TOML)
    assert "|".join(given_words(command)) == words
    parse(given_words(command))


def test_files_are_found_by_their_digest_beside_the_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    there = tmp_path / "elsewhere"
    OTHER.pendulum.save(there / "my arm.json", command="test")
    (there / "a damaged one.json").write_bytes(b"\xff\x00")
    (there / "evaluation.json").write_text(json.dumps({"pendulum": OTHER.pendulum.digest}))
    actuator = Actuator.assumed("kst", delay=0.02, lag=0.01)
    policy = OTHER.model_copy(update={"actuators": (actuator,)})
    words = next_step.train_again(policy, there / "policy.json")
    assert words[:2] == ("train", there / "my arm.json")
    OTHER.pendulum.save(tmp_path / "here.json", command="test")
    assert next_step.train_again(policy)[1] == Path("here.json")


def test_words_that_are_no_command_do_not_pass_the_check():
    for words in (("trane", "p.json"), ("train", "--sedes", "5"), ("evaluate", "a", "b")):
        with pytest.raises(Exception, match="No such|nexpected"):
            parse(words)
