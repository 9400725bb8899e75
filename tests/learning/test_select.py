"""Selection: the race of candidates, the test of the winner, and the errors of both."""

from collections import Counter

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from equipoise import paper
from equipoise.control.grid import TRACK
from equipoise.control.policy import shipped_policy
from equipoise.learning import select
from equipoise.learning.select import (
    confidence_sequence,
    kernel_of_tables,
    not_worse,
    trials_to_meet,
)
from equipoise.model.actuator import shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.random import SELECTION, TARGET_TEST
from equipoise.settings import resolve
from equipoise.worlds import Setup
from equipoise.worlds.ideal import PlantSimulation

# The confidence sequence


def probability_of_ever(event, share, looks, error):
    """Return the exact probability that bounds at any look satisfy an event, by recursion."""
    mass, total, before = {0: 1.0}, 0.0, 0
    for n in looks:
        later = {}
        for failed, p in mass.items():
            for more, q in enumerate(binom.pmf(np.arange(n - before + 1), n - before, 1.0 - share)):
                if p * q > 1e-11:
                    later[failed + more] = later.get(failed + more, 0.0) + p * q
        mass, before = {}, n
        for failed, p in later.items():
            if event(*confidence_sequence(n - failed, failed, error)):
                total += p
            else:
                mass[failed] = p
    return total


@pytest.mark.parametrize("share", [0.5, 0.985, 0.9999])
@pytest.mark.parametrize("error", [0.05, 0.01])
def test_the_bounds_exclude_the_share_at_any_look_with_less_than_their_error(share, error):
    looks = range(32, 1000, 32)
    wrong = probability_of_ever(lambda low, high: not low <= share <= high, share, looks, error)
    assert wrong <= error
    if share == 0.985:
        assert wrong > 0.1 * error  # ... and are not needlessly wide


def test_the_number_of_trials_that_meets_a_target_is_the_first_that_does():
    n = trials_to_meet(0.99, 0.025, 0, 0, 2000)
    assert n == 448
    assert confidence_sequence(n, 0, 0.025)[0] >= 0.99 > confidence_sequence(n - 64, 0, 0.025)[0]
    assert trials_to_meet(0.99, 0.025, 64, 3, 2000) > n
    assert trials_to_meet(0.99, 0.025, 64, 30, 2000) is None
    assert trials_to_meet(1.0, 0.025, 0, 0, 2000) is None
    # The last look is at the maximum.
    assert trials_to_meet(0.5, 0.05, 0, 0, 40) == 40


# The sign test


def test_a_candidate_leaves_by_the_exact_sign_test():
    rng = np.random.default_rng(1)
    for _ in range(50):
        steps = rng.integers(1, 5, (6, 40))
        kept = not_worse(steps, 0.01)
        for row, keep in zip(steps[1:], kept[1:], strict=True):
            shorter, longer = int(np.sum(row < steps[0])), int(np.sum(row > steps[0]))
            p = binomtest(shorter, shorter + longer, 0.5, alternative="greater").pvalue
            assert keep == (p > 0.01)
        assert kept[0]


# The race

QUICK = ("selection.duration=3", "selection.rounds=4", "selection.test_trials=300")


@pytest.fixture(scope="module")
def make_setup(pendulum):
    def make(*overrides):
        settings = resolve(overrides=[*QUICK, *overrides])
        return Setup(pendulum, iiwa(7), settings, shipped_actuator(), paper.STEP)

    return make


def race(setup, field, **given):
    return select.race(setup, field, seed=3, **given)


def measure_share(setup, table, **given):
    simulation = PlantSimulation("model", setup, seed=3, stream=TARGET_TEST)
    return select.measure_share(simulation, table, **given)


@pytest.fixture
def pairs(monkeypatch):
    """Spread, table and number of each trial that runs."""
    ran, original = [], PlantSimulation.run_piece

    def spy(self, policy, trials, rows, duration):
        spread = self.setup.spread
        ran.extend((spread, int(trials.table[i]), int(trials.number[i])) for i in rows)
        original(self, policy, trials, rows, duration)

    monkeypatch.setattr(PlantSimulation, "run_piece", spy)
    return ran


def candidates(count, good=2):
    """Random tables, with a policy that balances among them."""
    rng = np.random.default_rng(0)
    tables = [rng.choice(paper.ACTIONS, 270) for _ in range(count)]
    tables[good] = shipped_policy().u_of_box
    return [(20 * i, table) for i, table in enumerate(tables)]


@pytest.mark.compiled_only
def test_the_policy_that_balances_wins_and_no_pair_runs_twice(make_setup, pairs):
    field = candidates(30)
    order = race(make_setup(), field)
    assert sorted(i for i, _ in order) == list(range(30))
    assert order[0][0] == 2
    assert order[0][1].episodes == 40
    assert len(set(pairs)) == len(pairs) == sum(result.trials for _, result in order)
    # Equal trials for all: the numbers of each are those from the first on.
    counts = Counter(table for _, table, _ in pairs)
    for i, result in order:
        assert {n for _, table, n in pairs if table == i} == set(range(result.trials))
        assert counts[i] == result.trials
    # The others lose it soon.
    assert sorted(result.trials for _, result in order[1:])[15] <= 16


@pytest.mark.compiled_only
def test_a_result_is_that_of_the_policy_alone_on_the_same_trials(make_setup):
    setup, field = make_setup(), candidates(5)
    for i, result in race(setup, field):
        spread = setup.settings.selection.spread
        varied = setup._replace(spread=spread)
        simulation = PlantSimulation("model", varied, seed=3, stream=SELECTION)
        trials = simulation.draw(result.trials)
        kernel = kernel_of_tables(setup, field[i][1])
        simulation.run(kernel, trials, range(result.trials), duration=3.0)
        assert result.survived == np.sum(trials.cause == 0)
        assert result.mean_duration == pytest.approx(0.01 * np.mean(trials.steps), rel=1e-12)
        rms_x = np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps))
        assert result.rms_x == pytest.approx(rms_x, rel=1e-12)
        # mean duration / duration - weight rms(x) / 0.22 m, as the settings say.
        score = result.mean_duration / 3.0 - 0.2 * rms_x / 0.22
        assert result.score == pytest.approx(score, rel=1e-12)


@pytest.mark.compiled_only
def test_a_race_of_one_is_short_and_one_of_equals_runs_all_rounds(make_setup):
    good = shipped_policy().u_of_box
    assert race(make_setup(), [(1, good)])[0][1].trials == select.FIRST_BLOCK
    equal = race(make_setup("selection.duration=0.3"), [(1, good), (2, good)])
    assert [result.trials for _, result in equal] == [8 * select.FIRST_BLOCK] * 2
    assert equal[0][0] == 0


@pytest.mark.compiled_only
def test_the_trials_of_a_round_limit_the_candidates(make_setup, pairs):
    good = shipped_policy().u_of_box
    rng, field = np.random.default_rng(0), []
    for i in range(12):  # policies that differ in a box or two, of which most balance as well
        table = good.copy()
        table[rng.integers(0, 270, 2)] = rng.choice(paper.ACTIONS, 2)
        field.append((i, table))
    results = race(make_setup("selection.round_trials=48"), field)
    by_number = Counter(n for _, _, n in pairs)
    assert by_number[0] == 12
    assert all(by_number[n] <= 48 // 8 for n in range(8, 16))
    assert all(by_number[n] <= 48 // 16 for n in range(16, 32))
    assert results[0][1].score == max(r.score for _, r in results if r.trials == 32)


# The test


@pytest.mark.compiled_only
def test_a_test_ends_when_the_target_is_decided(make_setup):
    bad, good = (table for _, table in candidates(2, good=1))
    setup = make_setup("selection.test_trials=2000", "selection.duration=0.3")
    met = measure_share(setup, good, target=0.99, error=0.025)
    assert (met.met, met.trials, met.survived) == (True, 448, 448)
    assert met.interval[0] >= 0.99
    missed = measure_share(make_setup(), bad, target=0.99)
    assert (missed.met, missed.trials) == (False, 64)
    assert missed.interval[1] < 0.99
    assert sum(missed.causes.values()) == missed.trials
    assert missed.causes.get("lasted", 0) == missed.survived


def test_a_test_ends_when_failures_put_the_target_out_of_reach(make_setup, monkeypatch):
    failing = {5, 60, 100, 130}

    def fall(self, policy, trials, rows, duration):
        trials.cause[rows] = [TRACK * (int(trials.number[i]) in failing) for i in rows]

    monkeypatch.setattr(PlantSimulation, "run_piece", fall)
    setup, table = make_setup("selection.test_trials=500"), np.zeros(270)
    # The interval of three failures in 128 trials contains the target, and needs 576 to reach it.
    test = measure_share(setup, table, target=0.98)
    assert (test.met, test.trials, test.survived) == (False, 128, 125)
    assert test.causes == {"lasted": 125, "track": 3}
    assert test.interval[0] < 0.98 <= test.interval[1]
    assert trials_to_meet(0.98, select.ERROR, 128, 3, 500) is None
    # Without a failure the trials go on: the share is of interest, though the target is too high.
    failing.clear()
    test = measure_share(setup, table, target=1.0)
    assert (test.met, test.trials, test.survived) == (False, 500, 500)
