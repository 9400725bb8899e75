"""Claims: how often each policy is granted one, summed exactly, and how many trials it needs."""

import math
from fractions import Fraction
from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from equipoise.errors import InputError
from equipoise.simulation.evaluation import allowed_failures, lower_bound, trials_for

CLAIMS = [(0.99, 1000), (0.985, 200), (0.95, 59), (0.8, 37), (0.5, 101)]


def chance(least: int, trials: int, probability: float) -> Fraction:
    """Return the probability of at least so many successes, in whole numbers: without rounding."""
    p = Fraction(str(probability))
    a, b = p.numerator, p.denominator
    ways = sum(comb(trials, k) * a**k * (b - a) ** (trials - k) for k in range(least, trials + 1))
    return Fraction(ways, b**trials)


@pytest.mark.parametrize(("probability", "trials"), CLAIMS)
def test_at_exactly_the_claimed_rate_it_is_granted_in_one_of_twenty_at_most(probability, trials):
    least = trials - allowed_failures(trials, probability)
    assert 0 < least <= trials
    assert chance(least, trials, probability) <= Fraction(5, 100)
    # It is not stricter than it has to be: with one success fewer it would be granted too often.
    assert chance(least - 1, trials, probability) > Fraction(5, 100)


@given(fraction=st.floats(0.0, 1.0), confidence=st.floats(0.5, 0.999), trials=st.integers(1, 300))
def test_the_lower_bound_is_that_of_clopper_and_pearson(fraction, confidence, trials):
    k = round(fraction * trials)
    test = stats.binomtest(k, trials, alternative="greater")
    expected = test.proportion_ci(confidence, method="exact").low
    assert lower_bound(k, trials, confidence) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize(("probability", "trials", "fewer"), [(0.99, 1000, 500), (0.9, 100, 50)])
def test_a_policy_ten_times_better_is_granted_its_claim_and_fewer_trials_would_not_do(
    probability, trials, fewer
):
    better = float(1 - (1 - Fraction(str(probability))) / 10)
    granted = {n: chance(n - allowed_failures(n, probability), n, better) for n in (trials, fewer)}
    assert trials_for(probability) == trials
    assert granted[trials] >= 0.95 > granted[fewer]


@pytest.mark.parametrize("probability", [0.99, 0.3, 0.95])
def test_without_a_failure_the_least_number_of_trials_is_that_of_the_power(probability):
    least = math.ceil(math.log(0.05) / math.log(probability))
    assert allowed_failures(least, probability) == 0
    assert allowed_failures(least - 1, probability) == -1


def test_a_claim_that_takes_too_many_trials_is_refused():
    with pytest.raises(InputError, match="lower"):
        trials_for(0.9999999)
