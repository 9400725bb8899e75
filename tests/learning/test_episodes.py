"""The episode loop against a slow second implementation, and equation (1) by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise import paper
from equipoise.arm.iiwa import iiwa
from equipoise.arrays import fields
from equipoise.learning.choice import compile_functions
from equipoise.learning.episodes import (
    Totals,
    compiled_loop,
    exploration,
    new_training_state,
    training_config,
)
from equipoise.learning.q_learning import (
    Tables,
    Transition,
    best_action,
    best_value,
    learning_rate,
    move_towards,
    q_learning,
)
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.settings import resolve
from equipoise.simulation.plant import make_loop_params
from tests.reference import learning as reference

WORD = 2**32


def params(**changes):
    """Return constants of an update with some settings changed."""
    return training_config(resolve(), 5.0, 0).update._replace(**changes)


def problem(pendulum, recipe, *overrides, actuator=IDEAL_ACTUATOR):
    """Return the arguments of `train_episodes` that say what is to be learnt."""
    settings = resolve(recipe, overrides=overrides)
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    plant = make_loop_params(iiwa(14), settings, paper.STEP, parameters, actuator)
    return plant, parameters, settings


def trained(plant, parameters, settings, *stops, seed=0):
    """Return tables and totals after a training that stops and goes on."""
    training, config = new_training_state(270), training_config(settings, parameters.k, seed)
    train_episodes = compiled_loop(*compile_functions(settings.learning))
    for until in stops:
        train_episodes(plant, config, training, until, 16)
    return training.tables, fields(training.totals, Totals)


def same(progress, other):
    """Tell whether two trainings have the same table and counts, bit for bit."""
    (tables, totals), (others, counts) = progress, other
    pairs = zip((*tables, totals), (*others, counts), strict=True)
    return all(ours.tobytes() == theirs.tobytes() for ours, theirs in pairs)


# Against the slow loop


@pytest.mark.parametrize(
    ("recipe", "overrides"),
    [
        pytest.param("robust", ["learning.episode_duration=0.4"], marks=pytest.mark.full),
        ("robust", ["learning.epsilon_initial=0.5", "learning.mirrored=false"]),
        ("paper", ["learning.episode_duration=0.6"]),
        pytest.param("paper", ["learning.reward=alive"], marks=pytest.mark.full),
        (
            "paper",
            ["learning.mirrored=true", "plant.inertia_sigma=0.1", "learning.episode_duration=1"],
        ),
    ],
    ids=str,
)
def test_training_equals_the_slow_loop_bit_for_bit(pendulum, recipe, overrides):
    # Bits, not 1e-12: the same sums in the same order, and lanes do not see each other.
    plant, parameters, settings = problem(pendulum, recipe, "learning.episodes=100", *overrides)
    for until in (1, 100):
        tables, totals = trained(plant, parameters, settings, until, seed=11)
        theirs = reference.train(plant, parameters, settings, until, 11)
        assert (totals.begun, totals.ended) == (theirs.begun, theirs.ended)
        assert totals.steps == theirs.steps
        assert np.array_equal(tables.visits, theirs.visits)
        assert np.array_equal(tables.Q, theirs.Q)
    assert totals.running == 0
    assert np.count_nonzero(tables.visits) > 40


@pytest.mark.parametrize(
    "overrides",
    [["learning.episode_duration=0.4"], ["plant.zero_error=0.02", "controller.predict=false"]],
    ids=str,
)
@pytest.mark.parametrize("kind", ["lag", "kst"])
def test_training_behind_an_actuator_equals_the_slow_loop_bit_for_bit(pendulum, kind, overrides):
    # The same table from what the policy sees, on plants whose delay, lag and zero differ.
    plant, parameters, settings = problem(
        pendulum,
        "robust",
        "learning.episodes=50",
        "plant.delay_spread=0.006",
        *overrides,
        actuator=Actuator.assumed(kind, delay=0.0125, lag=0.01),
    )
    tables, totals = trained(plant, parameters, settings, 50, seed=5)
    theirs = reference.train(plant, parameters, settings, 50, 5)
    assert totals.steps == theirs.steps
    assert np.array_equal(tables.visits, theirs.visits)
    assert np.array_equal(tables.Q, theirs.Q)
    assert np.count_nonzero(tables.visits) > 40


# What the result depends on


@pytest.mark.parametrize("episodes", [1, 15, 17])
def test_fewer_episodes_than_lanes_are_trained_too(pendulum, episodes):
    plant, parameters, settings = problem(pendulum, "robust", f"learning.episodes={episodes}")
    tables, totals = trained(plant, parameters, settings, episodes)
    theirs = reference.train(plant, parameters, settings, episodes, 0)
    assert totals.tolist() == (episodes, episodes, 0, theirs.steps, theirs.steps)
    assert np.array_equal(tables.Q, theirs.Q)


def test_equal_seeds_give_equal_bits_wherever_one_stops_and_others_do_not(pendulum):
    given = problem(pendulum, "robust", "learning.episodes=30")
    first = trained(*given, 30, seed=3)
    assert same(first, trained(*given, *range(1, 31), seed=3))
    for seed in (4, 3 + 2**40):  # seeds have 64 bits: the upper ones count
        assert not same(first, trained(*given, 30, seed=seed))


# Equation (1)


def tables():
    return Tables(np.zeros((270, 8)), np.zeros((270, 8), np.int64), np.zeros((0, 270, 8)))


def test_one_update_is_equation_1():
    given = tables()
    Q, visits, _ = given
    Q[7, 3] = -0.5
    Q[20] = -0.25
    constants = params(gamma=0.9, alpha_initial=0.1, alpha_decay=0.0, mirrored=False)
    q_learning(given, Transition(7, 3, 0.0, 20, False, False, 0.0, 0.0, 0), constants)
    # (1 - 0.1) (-0.5) + 0.1 (0 + 0.9 (-0.25)) by hand.
    assert Q[7, 3] == pytest.approx(-0.4725, rel=1e-15)
    assert visits[7, 3] == 1


def test_a_mirrored_update_writes_the_image_and_nothing_else():
    given = tables()
    Q, visits, _ = given
    box = ((4 * 5 + 3) * 3 + 0) * 3 + 2
    image = ((1 * 5 + 1) * 3 + 2) * 3 + 0
    move_towards(given, box, 6, -1.0, params(alpha_initial=0.5, alpha_decay=0.0))
    assert np.flatnonzero(Q.ravel()).tolist() == sorted([box * 8 + 6, image * 8 + 1])
    assert Q[box, 6] == Q[image, 1] == -0.5
    assert visits[box, 6] == visits[image, 1] == visits.sum() / 2 == 1


def test_the_learning_rate_falls_with_the_visits_down_to_its_minimum():
    constants = params(alpha_initial=0.8, alpha_decay=0.5, alpha_minimum=0.1)
    rates = [learning_rate(visits, constants) for visits in (0, 2, 14, 15, 10**9)]
    assert rates == pytest.approx([0.8, 0.4, 0.1, 0.1, 0.1])
    constant = params(alpha_initial=0.1, alpha_decay=0.0, alpha_minimum=0.0)
    assert {learning_rate(n, constant) for n in (0, 1, 10**6)} == {0.1}


@given(targets=st.lists(st.floats(-1, 0), min_size=1, max_size=50))
def test_with_a_rate_of_one_over_n_a_value_is_the_mean_of_its_targets(targets):
    given = tables()
    Q, visits, _ = given
    Q[5, 5] = 123.0  # the first visit forgets what was there
    constants = params(alpha_initial=1.0, alpha_decay=1.0, alpha_minimum=0.0, mirrored=False)
    for target in targets:
        move_towards(given, 5, 5, target, constants)
    assert Q[5, 5] == pytest.approx(np.mean(targets), abs=1e-14)
    assert visits[5, 5] == len(targets)


# Exploration and ties


def test_exploration_falls_linearly_to_zero_over_its_share_of_the_episodes():
    config = training_config(resolve(), 5.0, 0)
    falling = config._replace(episodes=1000, epsilon_initial=0.4, epsilon_until=0.5)
    found = [exploration(n, falling) for n in (0, 125, 250, 500, 999)]
    assert found == pytest.approx([0.4, 0.3, 0.2, 0.0, 0.0])
    kept = falling._replace(epsilon_until=0.0)
    assert {exploration(n, kept) for n in (0, 500, 999)} == {0.4}


@given(
    row=st.lists(st.sampled_from([-1.0, -0.5, 0.0, -0.0]), min_size=8, max_size=8),
    word=st.integers(0, WORD - 1),
)
def test_a_best_action_is_one_of_the_best_each_with_the_same_share_of_the_words(row, word):
    Q = np.zeros((270, 8))
    Q[3] = row
    best = [action for action in range(8) if row[action] == max(row)]
    assert best_value(Q, 3) == max(row)
    assert best_action(Q, 3, word / WORD) == best[word * len(best) // WORD]
