"""`equipoise log verify` and `evaluate --verify`: every kind of file, intact and damaged."""

import re

import pytest

from equipoise.deployment import deploy
from equipoise.studies.certification import Certificate, certify, make_claim
from tests.cli.damage import DAMAGE, rebuilt


@pytest.fixture(scope="session")
def small_certificate(small_policy):
    """A claim that one failure undoes, and its trials: the table was hardly trained."""
    return certify(small_policy, make_claim(0.9, 0.9, 2.0, trials=22))


@pytest.fixture
def files(tmp_path, pendulum_file, policy_file, small_policy, small_evaluation, small_certificate):
    """One file of each kind."""
    small_evaluation.save(tmp_path / "evaluation.json", command="test")
    for value, name in zip(
        small_certificate, ("certificate.json", "certificate-evaluation.json"), strict=True
    ):
        value.save(tmp_path / name, command="test")
    deploy(small_policy, duration=0.5).save(tmp_path / "run.mcap", command="test")
    return tmp_path


HOLDS = {
    "pendulum.json": ("pendulum", "w2 = 70.2 1/s^2"),
    "policy.json": ("policy", "270 boxes by 8 actions for the iiwa14"),
    "evaluation.json": ("evaluation", "of 20 trials lasted 2 s on the iiwa14"),
    "certificate.json": ("certificate", "refused: the iiwa14's policy sha256:"),
    "run.mcap": ("run log", "of 0.5 s on the iiwa14, world model"),
}


@pytest.mark.parametrize("name", HOLDS)
def test_it_says_what_a_file_is_and_holds(equipoise, files, name):
    what, content = HOLDS[name]
    ran = equipoise("log", "verify", name)
    assert ran.code == 0
    assert f"an intact {what} " in ran.out
    assert content in ran.out
    assert re.search("digest +matches", ran.out)
    found = equipoise("log", "verify", name, "--json").json
    assert found["what"] == what
    assert found["digest"].startswith("sha256:")
    assert found["provenance"]["command"] == "test"


@pytest.mark.parametrize(
    "name", ["pendulum.json", "policy.json", "evaluation.json", "certificate.json"]
)
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused(refused, files, name, damage):
    damage(files / name)
    refused("log", "verify", name, saying=DAMAGE[damage])


def test_a_damaged_run_log_is_refused(refused, files):
    whole = (files / "run.mcap").read_bytes()
    for damaged in (whole[: len(whole) // 3], whole[:5], whole[:900] + whole[950:]):
        (files / "run.mcap").write_bytes(damaged)
        refused("log", "verify", "run.mcap", saying="run.mcap")


def test_what_is_no_file_of_ours_is_refused(refused, swing, tmp_path):
    refused("log", "verify", "nowhere.json", saying="there is no file nowhere.json")
    refused("log", "verify", swing, saying="is not a file of Equipoise")
    refused("log", "verify", tmp_path, saying="cannot read")
    refused("log", "verify", saying="Missing argument")


# A certificate


def test_a_certificate_says_how_to_repeat_it(equipoise, files):
    ran = equipoise("log", "verify", "certificate.json")
    assert "next: equipoise evaluate policy.json --verify certificate.json" in ran.out
    found = equipoise("log", "verify", "certificate.json", "--json").json
    assert "at least 90 %, at 90 % confidence, world model; 22 trials, " in found["content"]
    assert found["content"].endswith(", 0 failures allowed")
    assert "repeated" not in found


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
    refused(
        "log", "verify", "certificate.json", saying="does not hold the trials of the certificate"
    )
    # and without them it comes out otherwise.
    (files / "certificate-evaluation.json").unlink()
    assert equipoise("log", "verify", "certificate.json").code == 0
    ran = equipoise("evaluate", "policy.json", "--verify", "certificate.json")
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
