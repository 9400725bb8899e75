"""`equipoise evaluate`: a table and anybody's Python, exit codes, and what it refuses."""

import sys

import pytest

from equipoise.control.policy import TabularPolicy
from equipoise.worlds.evaluation import Evaluation
from tests.cli.damage import DAMAGE, rebuilt

STABLE = {
    "trials",
    "duration",
    "survived",
    "rate",
    "interval",
    "median_s",
    "outcomes",
    "yardsticks",
}
OWN = """
import numpy as np

def balance(state):
    x, x_dot, phi, phi_dot = state
    return 1.2 * x + 1.8 * x_dot + 24.0 * phi + 3.0 * phi_dot

class Balance:
    def act(self, state):
        return np.array([balance(state)])

ready = Balance()

def nothing(state): pass
def not_a_number(state): return float("nan")
def endless(state): return float("inf")
def words(state): return "left"
def broken(state): return 1 / 0
def late(state): return 0.0 if state[0] == 0.0 else None
def of_two(state, time): return 0.0
text = "left"

class Demanding:
    def __init__(self, gain): pass
    def act(self, state): return 0.0

class Actless: pass
"""


@pytest.fixture
def own(tmp_path):
    """A module of the user's in the current folder."""
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "unfinished.py").write_text("def balance(state:\n")
    (tmp_path / "needy.py").write_text("import no_such_library\n")
    yield
    for name in ("own", "unfinished", "needy"):
        sys.modules.pop(name, None)
    sys.path[:] = [folder for folder in sys.path if folder != str(tmp_path)]


def test_a_policy_is_shown_beside_the_yardsticks_and_saved(equipoise, policy_file, tmp_path):
    ran = equipoise("evaluate", policy_file, "--trials", 12)
    for name in ("policy", "LQR", "LQR, snapped", "PD", "random"):
        assert f"{name} " in ran.out
    assert "95 % interval" in ran.out
    saved = Evaluation.load(tmp_path / "evaluation.json")
    assert len(saved.results.survival) == 12
    assert saved.policy == TabularPolicy.load(policy_file).digest


def test_json_is_one_object_with_the_stable_keys(equipoise, policy_file):
    ran = equipoise("evaluate", policy_file, "--json")
    found = ran.json
    assert found.keys() >= STABLE
    assert (found["trials"], found["duration"]) == (20, 2.0)  # the policy's own settings
    assert found["rate"] == found["survived"] / 20
    low, high = found["interval"]
    assert low <= found["rate"] <= high
    assert sum(found["outcomes"].values()) == 20
    assert set(found["yardsticks"]) == {"LQR", "LQR, snapped", "PD", "random"}
    assert found["yardsticks"]["LQR"]["rate"] == 1.0
    assert ran.err == ""


def test_the_exit_code_says_whether_it_balances(equipoise, policy_file):
    # A table that was hardly trained stands for a tenth of a second, not for a minute.
    short = equipoise("evaluate", policy_file, "--duration", 0.05, "--trials", 5)
    assert short.code == 0
    assert "It balances" in short.out
    long = equipoise("evaluate", policy_file, "--duration", 60, "--trials", 5)
    assert long.code == 1
    assert "It does not balance" in long.out
    assert equipoise("evaluate", policy_file, "--duration", 60, "--trials", 5, "--json").code == 1


def test_equal_seeds_give_equal_evaluations_whatever_the_workers(equipoise, policy_file, tmp_path):
    for name, workers in (("one.json", 1), ("two.json", 2)):
        equipoise("evaluate", policy_file, "--workers", workers, "--seed", 5, "--out", name)
    one, two = (Evaluation.load(tmp_path / name) for name in ("one.json", "two.json"))
    assert one.digest == two.digest
    assert one.seed == 5


def test_the_policy_that_ships_balances(equipoise):
    ran = equipoise("evaluate", "--trials", 20, "--json")
    assert ran.code == 0
    assert ran.json["survived"] >= 19


@pytest.mark.parametrize("name", ["balance", "Balance", "ready"])
def test_functions_classes_and_objects_are_evaluated(equipoise, own, pendulum_file, name):
    asked = ("--policy", f"own:{name}", "--pendulum", pendulum_file, "--arm", "iiwa14")
    ran = equipoise("evaluate", *asked, "--trials", 3, "--duration", 1, "--json")
    assert ran.code == 0, ran
    assert ran.json["survived"] == 3


FUNCTIONS = {
    "own:nothing": "own:nothing returned None in the state x = 0",
    "own:not_a_number": "returned nan",
    "own:endless": "returned inf",
    "own:words": "returned 'left'",
    "own:broken": "ZeroDivisionError: division by zero",
    "own:late": "returned None",
    "own:of_two": "missing 1 required positional argument: 'time'",
    "own:text": "of type str, expected a function",
    "own:Demanding": "missing 1 required positional argument: 'gain'",
    "own:Actless": "has no act(observation)",
    "own:absent": "has no 'absent'",
    "own": "there is no policy own; give",
    ":balance": "expected MODULE:NAME",
    "own:": "expected MODULE:NAME",
    "own module:balance": "expected MODULE:NAME",
    "nowhere:balance": "there is no module 'nowhere'",
    "own.inner:balance": "there is no module 'own.inner'",
    "unfinished:balance": "SyntaxError",
    "needy:balance": "No module named 'no_such_library'",
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_python_that_is_no_policy_is_refused(refused, own, pendulum_file, name):
    asked = ("--policy", name, "--pendulum", pendulum_file)
    refused("evaluate", *asked, "--trials", 2, saying=FUNCTIONS[name])


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_policy_is_refused(refused, policy_file, damage):
    damage(policy_file)
    refused("evaluate", policy_file, saying=DAMAGE[damage])


def test_a_policy_with_other_boxes_or_actions_is_refused(refused, policy_file):
    original = policy_file.read_bytes()

    def other_boxes(body):
        body["settings"]["boxes"]["x"] = [-0.1, -0.05, 0.05, 0.1]

    def more_actions(body):
        body["actions"].append(3.0)

    def fewer_rows(body):
        body["Q"].pop()

    def another_field(body):
        body["mood"] = "good"

    for change, saying in (
        (other_boxes, "Q must have 450 rows"),
        (more_actions, "actions: Tuple should have at most 8 items"),
        (fewer_rows, "Q must have 270 rows"),
        (another_field, "mood"),
    ):
        policy_file.write_bytes(original)
        rebuilt(policy_file, change)
        refused("evaluate", policy_file, saying=saying)


def test_another_kind_of_file_is_refused(refused, pendulum_file, swing):
    saying = "holds 'equipoise-pendulum', expected 'equipoise-policy'"
    refused("evaluate", pendulum_file, saying=saying)
    refused("evaluate", swing, saying="is not a file of Equipoise")
    refused("evaluate", "nowhere.json", saying="there is no file nowhere.json")


def test_another_arm_or_pendulum_than_the_policys_is_refused(
    refused, equipoise, policy_file, pendulum_file, pendulum, tmp_path
):
    matching = ("--arm", "iiwa14", "--pendulum", pendulum_file, "--duration", 0.05)
    assert equipoise("evaluate", policy_file, *matching).code == 0
    other = pendulum.assumed(60.0, 0.1)
    other.save(tmp_path / "other.json", command="test")
    refused("evaluate", policy_file, "--arm", "iiwa7", saying="trained on the iiwa14, not on this")
    refused("evaluate", policy_file, "--pendulum", "other.json", saying="for another pendulum")


OPTIONS = {
    "unknown world": (("--world", "twin:mars"), "there is no world 'twin:mars'"),
    "no trials": (("--trials", "0"), "--trials"),
    "a billion trials": (("--trials", 10**9), "1000000000"),
    "trials beyond any integer": (("--trials", 10**30), "from 1 to 1000000"),
    "trials on a twin": (("--world", "twin:nominal", "--trials", 10**18), "from 1 to 1000000"),
    "trials below zero": (("--trials", "-5"), "--trials"),
    "no duration": (("--duration", "0"), "--duration is 0"),
    "a duration that is no number": (("--duration", "nan"), "--duration is nan"),
    "an endless duration": (("--duration", "inf"), "--duration is inf"),
    "no workers": (("--workers", "0"), "--workers"),
    "unknown arm": (("--arm", "ur5"), "there is no arm 'ur5'"),
    "held joint of an iiwa": (("--held", "2"), "held belong to an arm from a URDF"),
    "a policy and a function": (("--policy", "own:balance"), "give one of them"),
    "output is no JSON": (("--out", "evaluation.txt"), "ends in .json"),
    "output is the policy": (("--out", "policy.json"), "would be written over"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, policy_file, flaw):
    options, saying = OPTIONS[flaw]
    refused("evaluate", policy_file, *options, saying=saying)
