"""`equipoise evaluate --claim` and `--verify`: output, files, exit codes, and refusals."""

import pytest

from equipoise.control.policy import TabularPolicy
from equipoise.worlds.certification import Certificate, certify, make_claim
from equipoise.worlds.evaluation import Evaluation
from tests.cli.damage import DAMAGE, rebuilt

STABLE = {"granted", "claim", "bound", "trials", "failures"}
GRANTED = ("--claim", 0.9, "--confidence", 0.9, "--duration", 0.05)
REFUSED = ("--claim", 0.9, "--confidence", 0.9, "--duration", 60)
"""A table that was hardly trained stands for a tenth of a second, and often not for a minute."""


@pytest.mark.compiled_only
def test_a_claim_that_holds_is_granted_and_left_with_its_trials(equipoise, policy_file, tmp_path):
    ran = equipoise("evaluate", policy_file, *GRANTED)
    assert ran.code == 0, ran
    assert "lasts 0.05 s with a probability of at least 90 %, at 90 % confidence" in ran.out
    assert "100 trials, 5 failures allowed" in ran.out
    assert "100 of 100 lasted; none failed" in ran.out
    # 0.1^(1/100) = 0.977237..., rounded down
    assert "a probability of at least 97.723 %, at 90 % confidence" in ran.out
    assert "Granted: 0 failures, 5 allowed." in ran.out
    assert "next: equipoise evaluate" in ran.out
    certificate = Certificate.load(tmp_path / "certificate.json")
    evaluation = Evaluation.load(tmp_path / "certificate-evaluation.json")
    assert certificate.granted
    assert certificate.policy == TabularPolicy.load(policy_file).digest
    assert certificate.evaluation == evaluation.digest
    assert evaluation.baselines == ()


@pytest.mark.compiled_only
def test_a_claim_that_the_trials_do_not_support_is_refused(equipoise, policy_file, tmp_path):
    ran = equipoise("evaluate", policy_file, *REFUSED, "--out", "mine.json")
    assert ran.code == 1
    certificate = Certificate.load(tmp_path / "mine.json")
    assert not certificate.granted
    assert certificate.bound < 0.9
    assert certificate.failed > 5
    assert f"Refused: {certificate.failed} failures, 5 allowed. That does not dis" in ran.out
    assert "next: equipoise train" in ran.out


@pytest.mark.compiled_only
def test_json_is_one_object_with_the_stable_keys(equipoise, policy_file):
    ran = equipoise("evaluate", policy_file, *GRANTED, "--trials", 50, "--json")
    found = ran.json
    assert found.keys() >= STABLE
    assert found["granted"] is True
    assert found["claim"] == {
        "probability": 0.9,
        "confidence": 0.9,
        "duration": 0.05,
        "world": "model",
        "trials": 50,
    }
    assert (found["trials"], found["failures"], found["causes"]) == (50, 0, {})
    assert found["bound"] == pytest.approx(0.1 ** (1 / 50))
    assert ran.err == ""
    assert equipoise("evaluate", policy_file, *REFUSED, "--json").code == 1


@pytest.mark.compiled_only
def test_a_second_try_is_the_same_try(equipoise, policy_file, tmp_path):
    for name, workers in (("one.json", 1), ("two.json", 2)):
        equipoise("evaluate", policy_file, *REFUSED, "--workers", workers, "--out", name)
    one, two = (Certificate.load(tmp_path / name) for name in ("one.json", "two.json"))
    assert one.digest == two.digest


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_policy_is_refused(refused, policy_file, damage):
    damage(policy_file)
    refused("evaluate", policy_file, *GRANTED, saying=DAMAGE[damage])


OPTIONS = {
    "certainty": (("--claim", "1"), "probability is 1; it should be less than 1"),
    "a percentage": (("--claim", "99"), "probability is 99"),
    "no number": (("--claim", "nan"), "probability is nan"),
    "no confidence": (("--confidence", "0.2"), "confidence is 0.2"),
    "no duration": (("--duration", "0"), "duration is 0"),
    "an endless duration": (("--duration", "inf"), "duration is inf"),
    "no trials": (("--trials", "0"), "--trials"),
    "a billion trials": (("--trials", 10**9), "1000000000"),
    "trials beyond any integer": (("--trials", 10**30), "1000000"),
    "too few trials": (("--trials", "298"), "give 299 or more"),
    "unknown world": (("--world", "mars"), "there is no world 'mars'"),
    "a seed of its own": (("--seed", "3"), "--seed does not go with --claim; leave it out"),
    "limits": (
        ("--max-speed", "1", "--no-baselines"),
        "--max-speed and --no-baselines do not go with --claim",
    ),
    "no workers": (("--workers", "0"), "--workers"),
    "output is no JSON": (("--out", "certificate.txt"), "ends in .json"),
    "output is the policy": (("--out", "policy.json"), "would be written over"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, policy_file, flaw):
    options, saying = OPTIONS[flaw]
    refused("evaluate", policy_file, "--claim", "0.99", *options, saying=saying)


def test_trials_are_not_written_over_the_policy(refused, policy_file):
    beside = policy_file.rename(policy_file.with_name("mine-evaluation.json"))
    refused("evaluate", beside, *GRANTED, "--out", "mine.json", saying="would be written over")


def test_another_kind_of_file_is_refused(refused, pendulum_file):
    saying = "holds 'equipoise-pendulum', expected 'equipoise-policy'"
    refused("evaluate", pendulum_file, *GRANTED, saying=saying)
    refused("evaluate", "nowhere.json", *GRANTED, saying="there is no file nowhere.json")


# A certificate is repeated.


@pytest.fixture(scope="session")
def small_certificate(small_policy):
    """A claim that one failure undoes, and its trials: the table was hardly trained."""
    return certify(small_policy, make_claim(0.9, 0.9, 2.0, trials=22))


@pytest.fixture
def files(tmp_path, pendulum_file, policy_file, small_certificate):
    """A policy, its pendulum, a certificate, and the trials of the certificate."""
    certificate, evaluation = small_certificate
    certificate.save(tmp_path / "certificate.json", command="test")
    evaluation.save(tmp_path / "certificate-evaluation.json", command="test")
    return tmp_path


@pytest.mark.compiled_only
def test_with_its_policy_all_trials_come_out_the_same(equipoise, files):
    asked = ("evaluate", "policy.json", "--verify", "certificate.json")
    ran = equipoise(*asked)
    assert ran.code == 0, ran
    assert "Repeated: 22 trials again: " in ran.out
    assert "each lasted as long as before, refused." in ran.out
    repeated = equipoise(*asked, "--workers", 2, "--json").json
    certificate = Certificate.load(files / "certificate.json")
    assert repeated == {
        "granted": False,
        "claim": certificate.claim.model_dump(mode="json"),
        "bound": certificate.bound,
        "trials": 22,
        "failures": certificate.failed,
        "causes": certificate.failures,
        "same_outcome": True,
        "same_trials": True,
        "certificate": "certificate.json",
    }


@pytest.mark.compiled_only
def test_a_certificate_with_fewer_failures_than_its_trials_have_is_found(equipoise, refused, files):
    # A forgery that contradicts nothing in its own file ...
    def granted(body):
        body.update(granted=True, failures={}, bound=0.1 ** (1 / 22))

    rebuilt(files / "certificate.json", granted)
    # ... does not fit the trials beside it,
    asked = ("evaluate", "policy.json", "--verify", "certificate.json")
    refused(*asked, saying="does not hold the trials of the certificate")
    # and without them it comes out otherwise.
    (files / "certificate-evaluation.json").unlink()
    ran = equipoise(*asked)
    assert ran.code == 1
    assert "Not repeated: 22 trials again: " in ran.out
    assert "refused; the certificate says none failed, granted." in ran.out


def test_only_a_certificate_is_repeated_and_only_with_its_own_policy(refused, files, small_policy):
    saying = "holds 'equipoise-policy', expected 'equipoise-certificate'"
    refused("evaluate", "policy.json", "--verify", "policy.json", saying=saying)
    other = small_policy.model_copy(update={"seed": small_policy.seed + 1})
    other.save(files / "other.json", command="test")
    for policy, saying in (
        ("other.json", "about another policy"),
        ("pendulum.json", "holds 'equipoise-pendulum'"),
        ("nowhere.json", "there is no file nowhere.json"),
    ):
        refused("evaluate", policy, "--verify", "certificate.json", saying=saying)
    saying = "--trials and --duration do not go with --verify"
    options = ("--trials", 5, "--duration", 3)
    refused("evaluate", "policy.json", "--verify", "certificate.json", *options, saying=saying)
