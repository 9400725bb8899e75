"""Certification: who is granted a claim, summed exactly, and that a second try is the same try."""

import hashlib
import json
import math
from fractions import Fraction
from math import comb

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy import stats

from equipoise.errors import ArtefactError, InputError, SettingsError
from equipoise.model.worlds import TwinSettings, read_world
from equipoise.worlds import certification
from equipoise.worlds.certification import (
    ROUND_NUMBERS,
    Certificate,
    Claim,
    certify,
    check_evaluation,
    evaluation_path,
    least_successes,
    lower_bound,
    make_claim,
    repeat,
    trial_seed,
    trials_for,
)
from equipoise.worlds.evaluation import Evaluation, TrialResults, evaluate
from tests.cli.damage import rebuilt

CLAIMS = [
    (0.99, 0.95, 1000),
    (0.999, 0.95, 10_000),
    (0.985, 0.95, 200),
    (0.95, 0.95, 59),  # no failure is allowed, and with one trial less nothing is granted
    (0.9, 0.99, 100),
    (0.98, 0.9, 500),
    (0.995, 0.6, 777),
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


def test_a_true_999_in_a_thousand_is_granted_99_percent():
    least = least_successes(1000, 0.99, 0.95)
    # From tables of acceptance sampling: 913 trials allow 4 failures, 1049 allow 5.
    assert least == 996
    assert chance(least, 1000, 0.999) >= 0.95
    assert chance(least, 1000, 0.99) <= 0.05


@pytest.mark.parametrize(
    ("probability", "trials", "allowed"),
    # Sample sizes that every table of the exact test at 95 % has.
    [(0.99, 299, 0), (0.99, 473, 1), (0.99, 628, 2), (0.95, 59, 0), (0.95, 93, 1), (0.9, 29, 0)],
)
def test_the_known_sample_sizes_come_out(probability, trials, allowed):
    assert trials - least_successes(trials, probability, 0.95) == allowed
    assert trials - 1 - least_successes(trials - 1, probability, 0.95) == allowed - 1


@hypothesis.settings(max_examples=60)
@given(
    probability=st.floats(0.01, 0.999),
    confidence=st.floats(0.5, 0.999),
    trials=st.integers(1, 300),
)
def test_granted_means_that_the_lower_bound_reaches_the_claim(probability, confidence, trials):
    least = least_successes(trials, probability, confidence)
    # The bound in closed form, a quantile of the beta distribution.
    bounds = [
        stats.beta.ppf(1.0 - confidence, k, trials - k + 1) if k else 0.0 for k in range(trials + 1)
    ]
    assert all(bound < probability + 1e-12 for bound in bounds[:least])
    assert all(bound > probability - 1e-12 for bound in bounds[least:])
    for k in {0, trials // 2, trials}:
        assert lower_bound(k, trials, confidence) == pytest.approx(bounds[k], abs=1e-12)


def test_the_bound_where_none_failed_is_the_root_of_what_is_left_to_chance():
    assert lower_bound(1000, 1000, 0.95) == pytest.approx(0.05**0.001, abs=1e-12)
    assert lower_bound(0, 1000, 0.95) == 0.0


# The number of trials


@pytest.mark.parametrize(
    ("probability", "confidence", "trials"),
    [(0.99, 0.95, 1000), (0.999, 0.95, 10_000), (0.95, 0.95, 200), (0.9, 0.99, 100)],
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


def test_a_claim_gets_its_trials_from_its_numbers_alone():
    assert make_claim(0.99, 0.95, 60.0).trials == 1000
    assert make_claim(0.99, 0.95, 600.0, world="twin:harsh").trials == 1000
    assert make_claim(0.99, 0.95, 60.0, trials=500).trials == 500


def test_one_trial_fewer_than_the_least_is_refused():
    assert make_claim(0.99, 0.95, trials=299).allowed == 0
    with pytest.raises(InputError, match="even if all last; give 299 or more"):
        make_claim(0.99, 0.95, trials=298)


@hypothesis.settings(max_examples=60)
@given(probability=st.floats(0.01, 0.999), confidence=st.floats(0.5, 0.999))
def test_the_refusal_names_the_least_number_that_will_do(probability, confidence):
    least = math.ceil(math.log(1.0 - confidence) / math.log(probability))
    assert make_claim(probability, confidence, trials=least + 1).allowed >= 0
    if least > 1:
        with pytest.raises(InputError, match=f"give {least:,} or more"):
            make_claim(probability, confidence, trials=least - 1)


NO_CLAIMS = {
    "certainty": ({"probability": 1.0}, "probability is 1; it should be less than 1"),
    "nothing": ({"probability": 0.0}, "probability is 0"),
    "no number": ({"probability": math.nan}, "probability is nan"),
    "no confidence": ({"confidence": 0.3}, "confidence is 0.3"),
    "full confidence": ({"confidence": 1.0}, "confidence is 1"),
    "no time": ({"duration": 0.0}, "duration is 0"),
    "more than a day": ({"duration": 1e5}, "duration is 100000"),
    "part of a step": ({"duration": 60.005}, "not a multiple of the step of 0.01 s"),
    "no trials": ({"trials": 0}, "trials is 0"),
    "endless trials": (
        {"trials": 10**7},
        "trials is 10000000; it should be less than or equal to 1000000",
    ),
    "too much": ({"probability": 0.999999}, "takes more than 1,000,000 trials"),
}


@pytest.mark.parametrize("flaw", NO_CLAIMS)
def test_what_nobody_can_claim_is_refused_in_a_sentence(flaw):
    given, saying = NO_CLAIMS[flaw]
    with pytest.raises(InputError) as refusal:
        make_claim(**given)
    assert saying in str(refusal.value)


def test_the_world_of_a_claim_has_to_exist(tmp_path):
    assert make_claim(world="twin:nominal").world == "twin:nominal"
    file = tmp_path / "mine.toml"
    file.write_text("transport = 0.02\n")
    assert make_claim(world=f"twin:{file}").world == f"twin:{file}"
    for world in ("twin:mars", "mars", ""):
        with pytest.raises(SettingsError):
            make_claim(world=world)


# The seed


def test_the_seed_is_the_beginning_of_the_sha_256_of_policy_and_claim():
    claim = make_claim(0.99, 0.95, 60.0, world="twin:nominal")
    written = (
        '{"claim":{"confidence":0.95,"duration":60.0,"probability":0.99,"trials":1000,'
        '"world":"twin:nominal"},"policy":"sha256:abc"}'
    )
    digest = hashlib.sha256(written.encode()).digest()
    assert trial_seed("sha256:abc", claim) == int.from_bytes(digest[:4], "big")


def test_another_policy_or_claim_has_another_seed_and_the_same_has_the_same():
    claims = [
        make_claim(),
        make_claim(0.98),
        make_claim(confidence=0.9),
        make_claim(duration=30.0),
        make_claim(world="twin:nominal"),
        make_claim(world="twin:harsh"),
        make_claim(trials=2000),
    ]
    seeds = {trial_seed(policy, claim) for claim in claims for policy in ("one", "two")}
    assert len(seeds) == 2 * len(claims)
    assert all(0 <= seed < 2**32 for seed in seeds)
    # What the rule gives and what somebody asks for are one claim where they are equal.
    assert trial_seed("one", make_claim(0.99, 0.95, 60, trials=1000)) == trial_seed(
        "one", make_claim()
    )


# The certificate


@pytest.fixture
def fallen(monkeypatch, small_policy):
    """Certify on made-up trials: so many fall over, so many leave the track."""

    def made_up(policy, settings, *, seed, world, with_baselines, workers, partial, done):
        assert not with_baselines
        worlds.append(world)
        count, duration = settings.evaluation.trials, settings.evaluation.duration
        causes = ["angle"] * counts[0] + ["track"] * counts[1]
        causes += ["lasted"] * (count - len(causes))
        done(count)
        return Evaluation(
            policy=policy.digest,
            world="model" if world == "model" else world.name,
            world_settings=None if world == "model" else world.settings,
            arm=policy.arm.name,
            arm_digest=policy.arm.digest,
            actuators=(policy.actuator.digest,),
            pendulum=policy.pendulum.digest,
            settings=settings,
            seed=seed,
            results=TrialResults(
                name="policy",
                survival=tuple(duration if cause == "lasted" else 1.0 for cause in causes),
                causes=tuple(causes),
            ),
            baselines=(),
        )

    counts, worlds = [0, 0], []
    monkeypatch.setattr(certification, "evaluate", made_up)

    def run(angle=0, track=0, **claimed):
        counts[:] = angle, track
        return certify(small_policy, make_claim(**claimed))

    run.worlds = worlds
    return run


@pytest.mark.parametrize(("angle", "track", "granted"), [(0, 0, True), (3, 1, True), (1, 4, False)])
def test_the_last_failure_that_is_allowed_decides(fallen, angle, track, granted):
    certificate, evaluation = fallen(angle, track)
    assert certificate.granted is granted
    assert certificate.failed == angle + track
    assert sum(certificate.failures.values()) == certificate.failed
    assert (certificate.bound >= 0.99) is granted
    assert certificate.evaluation == evaluation.digest
    assert len(evaluation.results.outcomes) == certificate.claim.trials == 1000


def test_a_certificate_names_what_it_takes_to_repeat_it(fallen, small_policy):
    certificate, evaluation = fallen(2, duration=30.0, world="twin:harsh", trials=400)
    claim = certificate.claim
    assert claim == Claim(
        probability=0.99, confidence=0.95, duration=30.0, world="twin:harsh", trials=400
    )
    assert certificate.failures == {"angle": 2}
    assert certificate.policy == small_policy.digest
    assert certificate.seed == evaluation.seed == trial_seed(small_policy.digest, claim)
    assert certificate.world_settings == read_world("twin:harsh").settings
    assert (evaluation.world, evaluation.duration) == ("twin:harsh", 30.0)
    # All settings but number and length of the trials are the policy's own.
    asked, own = certificate.settings, small_policy.settings
    assert (asked.evaluation.trials, asked.evaluation.duration) == (400, 30.0)
    assert asked.plant == own.plant
    assert asked.evaluation.phi_high == own.evaluation.phi_high
    assert fallen()[0].world_settings is None


def test_a_certificate_comes_back_from_its_file(fallen, tmp_path):
    certificate, evaluation = fallen(1, 1)
    path = tmp_path / "certificate.json"
    certificate.save(path, command="test")
    assert Certificate.load(path) == certificate
    beside = evaluation_path(path)
    assert beside == tmp_path / "certificate-evaluation.json"
    evaluation.save(beside, command="test")
    check_evaluation(certificate, beside)
    fallen(1, 2)[1].save(beside, command="test")
    with pytest.raises(ArtefactError, match="does not hold the trials"):
        check_evaluation(certificate, beside)


UNTRUE = {
    "granted after all": {"granted": True},
    "a better bound": {"bound": 0.995},
    "more failures than trials": {"failures": {"angle": 1001}},
    "failures below zero": {"failures": {"angle": 6, "track": -1}},
    "fewer failures": {"failures": {"angle": 4}},
    "another seed": {"seed": 1},
    "another policy": {"policy": "sha256:abc"},
    "a world that it does not name": {"world_settings": TwinSettings().model_dump()},
}


@pytest.mark.parametrize("flaw", UNTRUE)
def test_a_certificate_that_contradicts_itself_is_refused(fallen, tmp_path, flaw):
    path = tmp_path / "certificate.json"
    fallen(5)[0].save(path, command="test")
    rebuilt(path, lambda body: body.update(UNTRUE[flaw]))
    with pytest.raises(ArtefactError, match="is not a valid 'equipoise-certificate' file"):
        Certificate.load(path)


def test_settings_that_are_not_those_of_the_claim_are_refused(fallen):
    body = json.loads(fallen()[0].model_dump_json())
    body["settings"]["evaluation"]["trials"] = 999
    with pytest.raises(ValidationError, match="the settings are not those of the claim"):
        Certificate.model_validate_json(json.dumps(body))


@pytest.mark.parametrize("kind", [Claim, Certificate])
def test_every_field_has_its_docstring(kind):
    assert all(field.description for field in kind.model_fields.values())


# Trying again


def test_the_same_failures_are_the_same_outcome_and_others_are_not(fallen, small_policy):
    certificate, _ = fallen(3, 1)
    again = repeat(certificate, small_policy)
    assert again == (True, {"angle": 3, "track": 1}, True, True)
    fallen(4, 1)  # from now on the trials come out so
    again = repeat(certificate, small_policy)
    assert again == (False, {"angle": 4, "track": 1}, False, False)


def test_another_policy_repeats_nothing(fallen, small_policy):
    certificate, _ = fallen()
    other = small_policy.model_copy(update={"seed": small_policy.seed + 1})
    with pytest.raises(ArtefactError, match="about another policy"):
        repeat(certificate, other)


def test_a_world_from_a_file_is_repeated_as_it_was(fallen, small_policy, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("transport = 0.02\n")
    certificate, _ = fallen(world=f"twin:{file}")
    mine = read_world("twin:nominal").settings.model_copy(update={"transport": 0.02})
    assert certificate.world_settings == mine
    file.unlink()
    assert repeat(certificate, small_policy).same_trials
    assert fallen.worlds == 2 * [(f"twin:{file}", mine)]


def test_a_named_world_has_its_own_numbers_and_no_others(fallen):
    body = json.loads(fallen(world="twin:nominal")[0].model_dump_json())
    body["world_settings"]["transport"] = 0.001
    with pytest.raises(ValidationError, match="are not those of twin:nominal"):
        Certificate.model_validate_json(json.dumps(body))


@pytest.mark.compiled_only
def test_a_second_try_is_the_same_try_whatever_the_workers(small_policy):
    # Half of the trials last as long as the median.
    median = evaluate(small_policy, with_baselines=False).results.summary().median
    claim = make_claim(0.5, 0.95, round(median, 2), trials=150)
    certificate, evaluation = certify(small_policy, claim)
    for workers in (1, 2):
        assert certify(small_policy, claim, workers=workers)[0].digest == certificate.digest
    assert 0 < certificate.failed < 150
    lasted = evaluation.results.outcomes.count("lasted")
    assert certificate.failed == 150 - lasted
    assert certificate.granted == (chance(lasted, 150, 0.5) <= Fraction(5, 100))
    again = repeat(certificate, small_policy, workers=2)
    assert again.same_outcome
    assert again.same_trials
    assert again.granted == certificate.granted


@pytest.mark.compiled_only
def test_its_trials_are_those_of_an_evaluation_with_that_seed(small_policy):
    told = []
    certificate, evaluation = certify(
        small_policy, make_claim(0.5, 0.9, 2.0, trials=70), done=told.append
    )
    assert sum(told) == 70
    plain = evaluate(
        small_policy, certificate.settings, seed=certificate.seed, with_baselines=False
    )
    assert plain == evaluation
