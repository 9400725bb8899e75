"""Value iteration over the boxes: its equation, its symmetry, and what it finds."""

import numpy as np
import pytest

from equipoise.control.grid import mirrored_box
from equipoise.model.actuator import shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.settings import resolve
from equipoise.studies.value_iteration import FAILED, CountSize, solve, solve_table

SHORT = ("selection.round_trials=24", "selection.rounds=3", "selection.duration=4")
SMALL = CountSize(rounds=2, loops=32, ticks=200)


def random_counts(rng, boxes=6):
    counts = rng.integers(0, 4, (boxes, 8, boxes + 1))
    counts[2, 5] = 0
    counts[3, 2] = 0  # the mirror image of the pair above
    return counts


def test_the_values_solve_bellmans_equation():
    rng, gamma = np.random.default_rng(0), 0.9
    N = random_counts(rng)
    Q = solve(N, gamma)
    boxes = len(N)
    mirrored = [mirrored_box(box, boxes) for box in range(boxes)] + [boxes]
    for s in range(boxes):
        for a in range(8):
            both = N[s, a] + N[mirrored[s], 7 - a, mirrored]
            if both.sum() == 0:
                assert Q[s, a] == FAILED
                continue
            p = both / both.sum()
            wanted = p[-1] * FAILED + gamma * sum(p[t] * Q[t].max() for t in range(boxes))
            assert Q[s, a] == pytest.approx(wanted, abs=1e-9)


def test_the_values_are_mirror_symmetric():
    Q = solve(random_counts(np.random.default_rng(1)), 0.95)
    assert pytest.approx(Q[::-1, ::-1]) == Q


def test_the_values_agree_with_a_direct_solution():
    """For the greedy policy of the solution, the linear system has the same values."""
    N, gamma = random_counts(np.random.default_rng(2)), 0.99
    Q = solve(N, gamma)
    both = N.astype(float)
    both += np.concatenate((N[::-1, ::-1, -2::-1], N[::-1, ::-1, -1:]), axis=2)
    p = both[np.arange(6), Q.argmax(axis=1)]
    p /= p.sum(axis=1, keepdims=True)
    values = np.linalg.solve(np.eye(6) - gamma * p[:, :-1], FAILED * p[:, -1])
    assert Q.max(axis=1) == pytest.approx(values, abs=1e-7)


@pytest.fixture(scope="module")
def solved(pendulum):
    settings = resolve(overrides=SHORT)
    return solve_table(pendulum, iiwa(7), settings, actuator=shipped_actuator(), size=SMALL, seed=4)


def test_every_step_is_counted_once(solved):
    assert np.sum(solved.visits) == solved.steps == 2 * 32 * 200
    assert [point.steps for point in solved.learning_curve] == [6400, 12800]
    assert len(solved.checkpoints) == 2


def test_equal_seeds_give_equal_tables(pendulum, solved):
    given = {"actuator": shipped_actuator(), "size": SMALL, "workers": 3}
    again = solve_table(pendulum, iiwa(7), resolve(overrides=SHORT), seed=4, **given)
    assert again.digest == solved.digest


@pytest.mark.slow
def test_value_iteration_finds_a_table_that_lasts(pendulum):
    table = solve_table(pendulum, iiwa(7), resolve(), actuator=shipped_actuator(), seed=0)
    assert table.checkpoints[0].mean_duration == pytest.approx(60.0, abs=0.5)
