"""Algorithms on a small world with a closed form, by hand, and guests' algorithms and rewards."""

from pathlib import Path

import numpy as np
import pytest

from equipoise.control.policy import Observation
from equipoise.errors import InputError, SettingsError
from equipoise.jit import kernel
from equipoise.learning.choice import ALGORITHMS, compile_functions, with_digests
from equipoise.learning.q_learning import Transition, UpdateParams, epsilon_greedy, new_tables
from equipoise.learning.rewards import REWARDS
from equipoise.learning.train import train
from equipoise.settings import LearningSettings, changed
from equipoise.user_code import load_object
from tests.reference import learning as reference

GAMMA, EPSILON, STATES = 0.9, 0.5, 3


EXAMPLES = Path(__file__).parents[2] / "examples" / "algorithms"


@pytest.fixture
def example(monkeypatch):
    """Return the algorithm of an example by its name."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return lambda name: load_object(f"{name}:algorithm", "algorithm")


def transition(box, action, reward, box_next, **changes):
    after = Transition(box, action, reward, box_next, False, False, EPSILON, 0.0, 0)
    return after._replace(**changes)


def corridor(state, action):
    """Return the next state on a corridor: to the left, right, or held; 0 is the fall."""
    return min(state + (-1, 1, 0, 0, 0, 0, 0, 0)[action], STATES)


def learned(algorithm, updates, seed=0):
    """Return the tables after a walk on the corridor, with falling learning rates."""
    tables = new_tables(270, algorithm.tables)
    params = UpdateParams(GAMMA, 1.0, 0.2, 0.0, False)
    rng = np.random.default_rng(seed)
    state = int(rng.integers(1, STATES + 1))
    action = epsilon_greedy(tables.Q, state, EPSILON, *rng.random(2))
    for _ in range(updates):
        after = corridor(state, action)
        failed, ended = after == 0, after == 0 or rng.random() < 0.05
        given = transition(state, action, -float(failed), after)
        given = given._replace(failed=failed, ended=ended, chance=rng.random())
        algorithm.update(tables, given, params)
        state = int(rng.integers(1, STATES + 1)) if ended else after
        action = epsilon_greedy(tables.Q, state, EPSILON, *rng.random(2))
    return tables


@pytest.mark.parametrize(
    ("name", "updates"),
    [
        ("q_learning", 60_000),
        pytest.param("watkins", 10_000, marks=pytest.mark.full),
        pytest.param("double_q", 60_000, marks=pytest.mark.full),
    ],
)
def test_algorithms_of_the_best_policy_find_its_values(example, name, updates):
    # The best policy never falls: Q* is 0 but for the step into the fall, -1, and each way is seen.
    algorithm = ALGORITHMS.get(name) or example(name)
    if name == "watkins":  # in Python its traces take a millisecond for each update
        algorithm = algorithm._replace(update=kernel(algorithm.update, cached=False))
    Q = learned(algorithm, updates).Q
    exact = np.zeros((STATES + 1, 8))
    exact[1, 0] = -1.0
    # Actions that look bad are tried seldom, and still remember some of their first targets.
    np.testing.assert_allclose(Q[1 : STATES + 1], exact[1:], atol=0.06)


@pytest.mark.full
def test_expected_sarsa_finds_the_values_of_the_policy_that_explores(example):
    # Against the closed form of its own last policy: Q = (1 - gamma P)^-1 r, with P by its greedy
    # action and epsilon. Exploration falls off the edge in 6 % of the steps beside it.
    Q = learned(example("expected_sarsa"), 200_000).Q
    pairs = [(s, a) for s in range(1, STATES + 1) for a in range(8)]
    index = {pair: n for n, pair in enumerate(pairs)}
    P, r = np.zeros((len(pairs), len(pairs))), np.zeros(len(pairs))
    for (s, a), n in index.items():
        after = corridor(s, a)
        if after == 0:
            r[n] = -1.0
            continue
        for b in range(8):
            P[n, index[after, b]] += EPSILON / 8
        P[n, index[after, int(np.argmax(Q[after]))]] += 1.0 - EPSILON
    exact = np.linalg.solve(np.eye(len(pairs)) - GAMMA * P, r).reshape(STATES, 8)
    # Beside the edge it knows that exploring costs; there the best policy has 0 but for the fall.
    assert exact[0, 2:].max() < -0.05
    np.testing.assert_allclose(Q[1 : STATES + 1], exact, atol=0.05)


def test_rewards_are_those_of_the_reference():
    state = Observation(0.1, 0.2, 0.3, 0.4)
    assert set(REWARDS) == set(reference.REWARDS)
    for name, reward in REWARDS.items():
        for failed in (False, True):
            expected = reference.REWARDS[name](state.x, state.phi, failed)
            assert reward(state, 0.4, state, failed) == expected


# Guests

GUEST = """
from equipoise.learning.q_learning import best_value, move_towards

def failure(state, u, next_state, failed):
    return -1.0 if failed else 0.0

def update(tables, transition, params):
    target = transition.reward
    if not transition.failed:
        target += params.gamma * best_value(tables.Q, transition.box_next)
    move_towards(tables, transition.box, transition.action, target, params)

def nothing(state, u, next_state, failed):
    pass

def inner(x):
    return x

def plain(state, u, next_state, failed):
    return inner(u)

def imports(state, u, next_state, failed):
    import math
    return math.cos(u)

def wild(tables, transition, params):
    tables.Q[270, 0] = 1.0

def late(tables, transition, params):
    if tables.visits[transition.box, transition.action] > 3:
        raise ValueError("\\x1b[2J")
    tables.visits[transition.box, transition.action] += 1

number = 3
"""


@pytest.fixture
def guest(tmp_path, monkeypatch):
    monkeypatch.delitem(__import__("sys").modules, "guest_of_tests", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "guest_of_tests.py"
    path.write_text(GUEST)
    return path


def trained(policy, settings, **changes):
    settings = changed(settings, {f"learning.{name}": value for name, value in changes.items()})
    return train(policy.pendulum, policy.arm, settings, actuator=policy.actuator, seed=7)


@pytest.mark.full
def test_a_guest_that_does_what_ours_does_gives_our_bits(guest, small_policy, quick_settings):
    ours = {"algorithm": "guest_of_tests:update", "reward": "guest_of_tests:failure"}
    made = trained(small_policy, quick_settings, **ours)
    assert (made.Q, made.visits) == (small_policy.Q, small_policy.visits)
    # It says whose source made it, and can be trained again from its own settings.
    assert made.settings.learning.algorithm.startswith("guest_of_tests:update@")
    again = trained(small_policy, made.settings)
    assert again == made
    guest.write_text(GUEST + "# changed\n")
    with pytest.raises(InputError, match="source of guest_of_tests:update has changed"):
        trained(small_policy, made.settings)


REFUSED = {
    "sarza": "algorithm",
    "nowhere_at_all:update": "algorithm",
    "guest_of_tests:missing": "reward",
    "guest_of_tests:number": "algorithm",
}


@pytest.mark.parametrize("name", REFUSED)
def test_unusable_objects_are_refused_in_one_sentence(guest, name):
    with pytest.raises((InputError, SettingsError)) as refusal:
        compile_functions(with_digests(LearningSettings(**{REFUSED[name]: name})))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "line", "reason"),
    [
        ("plain", "def plain", "'inner'"),
        ("imports", "def imports", "IMPORT_NAME"),
        ("nothing", "def nothing", "No conversion from none to float64"),
    ],
)
def test_a_function_that_cannot_be_compiled_is_named_with_its_line(guest, name, line, reason):
    lines = guest.read_text().splitlines()
    (number,) = (i for i, text in enumerate(lines, start=1) if line in text)
    with pytest.raises(InputError, match=r"^.* cannot be compiled .*$") as refusal:
        compile_functions(with_digests(LearningSettings(reward=f"guest_of_tests:{name}")))
    assert reason in str(refusal.value)
    assert f"({guest}, line {number})" in str(refusal.value)


@pytest.mark.full
@pytest.mark.parametrize(("name", "error"), [("late", "ValueError"), ("wild", "IndexError")])
def test_an_error_of_compiled_code_ends_the_training(
    guest, small_policy, quick_settings, capfd, name, error
):
    with pytest.raises(InputError, match=rf"{name}@.* raised {error}") as refusal:
        trained(small_policy, quick_settings, algorithm=f"guest_of_tests:{name}")
    assert "\x1b" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")
