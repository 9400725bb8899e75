"""Certification: who is granted a claim, summed exactly, and that a second try is the same try."""

import hashlib
import math
from fractions import Fraction
from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from equipoise.errors import ArtefactError, InputError
from equipoise.outcomes import Outcome
from equipoise.settings import resolve
from equipoise.worlds.certification import (
    ROUND_NUMBERS,
    Certificate,
    certify,
    least_successes,
    make_claim,
    trial_seed,
    trials_for,
)
from equipoise.worlds.evaluation import TrialResults, evaluate, lower_bound
from tests.cli.damage import rebuilt

CLAIMS = [
    (0.99, 0.95, 1000),
    (0.985, 0.95, 200),
    (0.95, 0.95, 59),  # no failure is allowed, and with one trial less nothing is granted
    (0.8, 0.999, 37),
    (0.5, 0.75, 2),  # a tie: two of two happen in exactly a quarter of all cases
    (0.5, 0.5, 101),  # another: more than half of an odd number in exactly half of all cases
]


def chance(least: int, trials: int, probability: float) -> Fraction:
    """Return the probability of at least so many successes, in whole numbers: without rounding."""
    p = Fraction(str(probability))
    a, b = p.numerator, p.denominator
    ways = sum(comb(trials, k) * a**k * (b - a) ** (trials - k) for k in range(least, trials + 1))
    return Fraction(ways, b**trials)


# The bound


@pytest.mark.parametrize(("probability", "confidence", "trials"), CLAIMS)
def test_at_exactly_the_claimed_rate_it_is_granted_as_seldom_as_the_confidence_says(
    probability, confidence, trials
):
    least = least_successes(trials, probability, confidence)
    wrongly = 1 - Fraction(str(confidence))
    assert 0 < least <= trials
    assert chance(least, trials, probability) <= wrongly
    # It is not stricter than it has to be: with one success fewer it would be granted too often.
    assert chance(least - 1, trials, probability) > wrongly


@given(share=st.floats(0.0, 1.0), confidence=st.floats(0.5, 0.999), trials=st.integers(1, 300))
def test_the_lower_bound_is_that_of_clopper_and_pearson(share, confidence, trials):
    k = round(share * trials)
    test = stats.binomtest(k, trials, alternative="greater")
    expected = test.proportion_ci(confidence, method="exact").low
    assert lower_bound(k, trials, confidence) == pytest.approx(expected, abs=1e-10)


# The number of trials


@pytest.mark.parametrize(
    ("probability", "confidence", "trials"),
    [(0.99, 0.95, 1000), (0.9, 0.99, 100)],
)
def test_a_policy_ten_times_better_is_granted_its_claim_and_fewer_trials_would_not_do(
    probability, confidence, trials
):
    better = float(1 - (1 - Fraction(str(probability))) / 10)
    fewer = ROUND_NUMBERS[ROUND_NUMBERS.index(trials) - 1]
    granted = {
        n: chance(least_successes(n, probability, confidence), n, better) for n in (trials, fewer)
    }
    assert trials_for(probability, confidence) == trials
    assert granted[trials] >= 0.95 > granted[fewer]


@pytest.mark.parametrize(("probability", "confidence"), [(0.99, 0.95), (0.3, 0.9), (0.95, 0.999)])
def test_the_refusal_names_the_least_number_that_will_do(probability, confidence):
    least = math.ceil(math.log(1.0 - confidence) / math.log(probability))
    assert make_claim(probability, confidence, trials=least).allowed == 0
    with pytest.raises(InputError, match=f"{least:,}"):
        make_claim(probability, confidence, trials=least - 1)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("probability", (1.0, 0.0, math.nan, 0.999999)),
        ("confidence", (0.3, 1.0)),
        ("duration", (0.0, 1e5, 60.005)),
        ("trials", (0, 10**7)),
        ("world", ("twin:mars", "")),
    ],
)
def test_an_impossible_claim_is_refused(name, values):
    for value in values:
        with pytest.raises(InputError):
            make_claim(**{name: value})


def test_the_seed_is_the_beginning_of_the_sha_256_of_policy_and_claim():
    claim = make_claim(0.99, 0.95, 60.0, world="twin:nominal")
    written = (
        '{"claim":{"confidence":0.95,"duration":60.0,"probability":0.99,"trials":1000,'
        '"world":"twin:nominal"},"policy":"sha256:abc"}'
    )
    digest = hashlib.sha256(written.encode()).digest()
    assert trial_seed("sha256:abc", claim) == int.from_bytes(digest[:4], "big")


# The certificate


def certificate_of(policy, angle, track):
    """Certify a claim on made-up trials: so many fall over, so many leave the track."""
    claim = make_claim()
    settings = resolve(overrides=["evaluation.trials=1", "evaluation.duration=60"])
    seed = trial_seed(policy.digest, claim)
    one = evaluate(policy, settings, world=claim.world, seed=seed, with_baselines=False)
    ends = [Outcome.ANGLE] * angle + [Outcome.TRACK] * track
    ends += [Outcome.LASTED] * (claim.trials - len(ends))
    survival = tuple(60.0 if end == Outcome.LASTED else 1.0 for end in ends)
    results = TrialResults(name="policy", survival=survival, outcomes=tuple(ends))
    return Certificate(claim=claim, evaluation=one.model_copy(update={"results": results}))


@pytest.mark.compiled_only
@pytest.mark.parametrize(("angle", "track", "granted"), [(0, 0, True), (3, 1, True), (1, 4, False)])
def test_the_last_failure_that_is_allowed_decides(small_policy, tmp_path, angle, track, granted):
    certificate = certificate_of(small_policy, angle, track)
    assert certificate.granted is granted
    assert certificate.failed == angle + track
    assert (certificate.bound >= 0.99) is granted
    certificate.save(tmp_path / "certificate.json", command="test")
    assert Certificate.load(tmp_path / "certificate.json") == certificate


@pytest.mark.compiled_only
@pytest.mark.parametrize("change", [{"probability": 0.5}, {"duration": 59.0}, {"trials": 999}])
def test_trials_of_another_claim_are_refused(small_policy, tmp_path, change):
    path = tmp_path / "certificate.json"
    certificate_of(small_policy, 5, 0).save(path, command="test")
    rebuilt(path, lambda body: body["claim"].update(change))
    with pytest.raises(ArtefactError):
        Certificate.load(path)


@pytest.mark.compiled_only
def test_a_second_try_is_the_same_try_whatever_the_workers(small_policy):
    # Half of the trials last as long as the median.
    median = evaluate(small_policy, with_baselines=False).results.summary().median
    claim, done = make_claim(0.5, 0.95, round(median, 2), trials=150), []
    certificate = certify(small_policy, claim, done=done.append)
    assert sum(done) == 150
    assert certify(small_policy, claim, workers=2).digest == certificate.digest
    lasted = certificate.evaluation.results.summary().survived
    assert 0 < certificate.failed == 150 - lasted < 150
    assert certificate.granted == (chance(lasted, 150, 0.5) <= Fraction(5, 100))
    evaluation = certificate.evaluation
    assert evaluation == evaluate(
        small_policy, evaluation.settings, seed=evaluation.seed, with_baselines=False
    )
