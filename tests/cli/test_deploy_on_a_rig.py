"""`equipoise deploy --robot`: the course as a user sees it."""

import pytest

from equipoise.control.policy import shipped_policy
from equipoise.logs.run_log import RunLog
from tests.cli.conftest import contents

pytestmark = pytest.mark.compiled_only


def test_a_run_on_a_twin_is_told_and_written(equipoise, tmp_path):
    ran = equipoise("deploy", "--robot", "twin:nominal", "--duration", 1, "--json")
    assert ran.code == 0, ran
    assert ran.json["outcome"] == "lasted"
    assert ran.json["lasted_s"] == 1.0
    # The operator is notified, although a program reads the result.
    assert "Armed. Let go." in ran.err
    assert "Moving to home" in ran.err
    assert RunLog.load(tmp_path / "run.mcap", damaged=True).end.outcome == "lasted"


def test_a_run_on_a_twin_is_filmed(equipoise, tmp_path, monkeypatch):
    filmed = []
    monkeypatch.setattr("equipoise.film.write_film", lambda *asked: filmed.append(asked))
    options = ("--robot", "twin:nominal", "--duration", 1, "--video", "run.mp4")
    assert equipoise("deploy", *options, "--json").json["video"] == "run.mp4"
    log, path, *_ = filmed[0]
    assert (log.end.outcome, str(path)) == ("lasted", "run.mp4")


def test_a_table_that_fell_in_its_final_round_runs_only_anyway(equipoise, refused, tmp_path):
    shipped = shipped_policy()
    test = shipped.test.model_copy(update={"trials": 200, "survived": 184})
    shipped.model_copy(update={"tests": (test,)}).save(tmp_path / "weak.json", command="test")
    run = ("deploy", "weak.json", "--robot", "twin:nominal", "--dry-run")
    refused(*run, saying="the policy lasted 184 of 200 trials in the final round of its training")
    assert equipoise(*run, "--anyway").code == 0
    test = test.model_copy(update={"survived": 185})
    shipped.model_copy(update={"tests": (test,)}).save(tmp_path / "good.json", command="test")
    assert equipoise("deploy", "good.json", *run[2:]).code == 0


def test_a_dry_run_ends_before_the_arm_moves(equipoise):
    ran = equipoise("deploy", "--robot", "twin:nominal", "--dry-run")
    assert ran.code == 0, ran
    assert "good" in ran.out
    assert "nothing has moved" in ran.out
    assert "Moving to home" not in ran.out


KST, BOARD = "kst://127.0.0.1:9", "serial:///dev/nowhere"
REFUSED = {
    "a dry run without a rig": (("--dry-run",), "give --robot"),
    "T1 without a rig": (("--t1",), "give --robot"),
    "an encoder without a rig": (("--encoder", BOARD), "give --robot"),
    "no encoder": (("--robot", KST), "give --encoder"),
    "no scheme": (("--robot", "host"), "is no address of a robot"),
    "another robot": (("--robot", "ros://host", "--encoder", BOARD), "kst://HOST:30001"),
    "the model": (("--robot", "model:"), "is no address of a robot"),
    "port 0": (("--robot", "kst://host:0", "--encoder", BOARD), "expected 1 to 65535"),
    "an empty label": (("--robot", "kst://a..b", "--encoder", BOARD), "invalid host name"),
    "a long label": (("--robot", f"kst://{64 * 'a'}", "--encoder", BOARD), "invalid host name"),
    "no UTF-8": (("--robot", "kst://h\udcff", "--encoder", BOARD), "invalid host name"),
    "no port": (("--robot", "kst://host:x", "--encoder", BOARD), "expected 1 to 65535"),
    "another encoder": (("--robot", KST, "--encoder", "usb:///x"), "expected serial:///dev"),
    "a socket without a port": (("--robot", KST, "--encoder", "socket://h"), "expected serial://"),
    "no such twin": (("--robot", "twin:nowhere"), "there is no world 'twin:nowhere'"),
    "no name": (("--robot", "twin:w\udcff.toml"), "is not UTF-8; give the file another name"),
    "two encoders": (("--robot", "twin:nominal", "--encoder", BOARD), "leave --encoder out"),
    "two worlds": (
        ("--robot", "twin:nominal", "--world", "twin:harsh"),
        "--world does not go with --robot",
    ),
    "an excitation": (("--robot", "twin:nominal", "--excite"), "--excite does not go with --robot"),
    "a film of another kind": (("--robot", "twin:nominal", "--video", "x.gif"), "ends in .mp4"),
    "no rig": (("--robot", "twin:nominal", "--rig", "none.toml"), "there is no file none.toml"),
    "a rig without a robot": (("--rig", "rig.toml"), "give --robot"),
    "an unknown key": (("--robot", "twin:nominal", "--rig", "unknown.toml"), "no such setting"),
    "no TOML": (("--robot", "twin:nominal", "--rig", "binary.toml"), "is not valid TOML"),
    "no policy": (("nowhere.json", "--robot", "twin:nominal"), "there is no file nowhere.json"),
    "a rig as a policy": (("rig.toml", "--robot", "twin:nominal"), "is not a file of Equipoise"),
    "an ideal arm": (("--robot", KST, "--encoder", BOARD, "--actuator", "ideal"), "ideal, trained"),
    "another arm": (("--robot", KST, "--encoder", BOARD, "--rig", "rig14.toml"), "has iiwa14"),
    "another log": (("--robot", "twin:nominal", "--out", "run.csv"), "ends in .mcap"),
    "a log in a file": (("--robot", "twin:nominal", "--out", "rig.toml/x.mcap"), "is a file"),
    "no duration": (("--robot", "twin:nominal", "--duration", "nan"), "from 0.01 to 3600"),
}


@pytest.mark.parametrize("flaw", REFUSED)
def test_what_cannot_be_meant_is_refused_before_anything_is_opened(refused, tmp_path, flaw):
    (tmp_path / "rig.toml").write_text("arm = 'iiwa7'\n")
    (tmp_path / "rig14.toml").write_text("arm = 'iiwa14'\n")
    (tmp_path / "unknown.toml").write_text("arms = 'iiwa7'\n")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    options, saying = REFUSED[flaw]
    refused("deploy", *options, saying=saying)


@pytest.mark.parametrize(
    "options", [pytest.param(("--force",), marks=pytest.mark.slow), ("--out", "mine.mcap")]
)
def test_a_connection_that_fails_is_told_in_one_sentence_and_leaves_no_file(
    equipoise, tmp_path, monkeypatch, options
):
    monkeypatch.setattr("sys.stdin", None)
    (tmp_path / "run.mcap").write_bytes(b"the log of an earlier run")
    ran = equipoise("deploy", "--robot", KST, "--encoder", BOARD, *options)
    assert ran.code == 3
    assert ran.err.startswith("error: there is no device /dev/nowhere; plug the board in")
    assert len(ran.err.splitlines()) == 1, ran
    assert "wrote" not in ran.out
    assert contents(tmp_path) == {"run.mcap": b"the log of an earlier run"}


def test_a_run_on_a_twin_keeps_the_log_of_an_earlier_run(equipoise, tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"the log of an earlier run")
    ran = equipoise("deploy", "--robot", "twin:nominal", "--dry-run")
    assert ran.code == 0, ran
    assert "run.mcap exists and is kept; the result goes to run-2.mcap" in ran.out
    assert "wrote run-2.mcap" in ran.out
    assert RunLog.load(tmp_path / "run-2.mcap", damaged=True).end.outcome == "dry run"
    assert (tmp_path / "run.mcap").read_bytes() == b"the log of an earlier run"
    refused = equipoise("deploy", "--robot", "twin:nominal", "--dry-run", "--out", "run.mcap")
    assert refused.code == 2
    assert "run.mcap exists; give another --out, or --force" in refused.err
    forced = equipoise("deploy", "--robot", "twin:nominal", "--dry-run", "--force", "--json")
    assert forced.json["run"] == "run.mcap"
    assert RunLog.load(tmp_path / "run.mcap", damaged=True).end.outcome == "dry run"
    assert sorted(contents(tmp_path)) == ["run-2.mcap", "run.mcap"]


def test_a_policy_for_another_arm_is_refused(refused, policy_file):
    run = "deploy", policy_file, "--robot", "twin:nominal", "--anyway"
    refused(*run, saying="on iiwa14, the rig has iiwa7")


def test_a_policy_that_is_too_fast_for_t1_is_refused_before_anything_is_connected(
    equipoise, tmp_path
):
    policy = shipped_policy()
    plant = policy.settings.plant.model_copy(update={"max_speed": 0.05})
    settings = policy.settings.model_copy(update={"plant": plant})
    policy.model_copy(update={"settings": settings}).save(tmp_path / "fast.json", command="test")
    ran = equipoise("deploy", "fast.json", "--robot", "twin:nominal", "--t1")
    assert ran.code == 2
    assert "lasts 20 s in 0 of 20 trials, expected 18 (ended by: flange speed 20)" in ran.err
    assert "equipoise train --max-speed 0.23" in ran.err
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.slow
def test_a_policy_that_lives_with_t1_runs_there(equipoise):
    ran = equipoise("deploy", "--robot", "twin:nominal", "--t1", "--duration", 1, "--json")
    assert ran.code == 0, ran
    assert "0.23 m/s (T1)" in ran.err
    assert ran.json["outcome"] == "lasted"
