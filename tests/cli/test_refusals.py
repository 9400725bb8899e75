"""Bad input: exit code 2 and one sentence before the work begins, and no file."""

import pytest

from tests.cli.damage import cut

KST, BOARD = "kst://127.0.0.1:9", "serial:///dev/nowhere"
TWIN = ("deploy", "--robot", "twin:nominal")

REFUSED = {
    # Names of files
    ("evaluate", "none.json"): "none.json",
    ("evaluate", "--out", "x.txt"): "ends in .json",
    ("evaluate", "small.json", "--out", "small.json"): "is read and would be written over",
    ("evaluate", "--out", "taken.json"): "--force",
    ("evaluate", "--out", "folder.json"): "is a folder",
    ("evaluate", "--out", "taken.json/x.json"): "takes no files",
    ("identify", "swing.csv", "--out", "p.txt"): "ends in .json",
    ("deploy", "--out", "run.json"): "ends in .mcap",
    ("log", "export", "cut.mcap", "--out", "full"): "is not empty",
    ("log", "export", "cut.mcap", "--video", "x.gif"): ".webp",
    ("log", "export", "cut.mcap", "--from", "1"): "--video",
    ("reproduce", "--out", "full"): "is not empty",
    ("reproduce", "--start", "1"): "--swing",
    # Kinds of files
    ("evaluate", "cut.json"): "",
    ("evaluate", "pen.json"): "equipoise-policy",
    ("train", "swing.csv"): "equipoise identify swing.csv",
    ("train", "--actuator", "cut.mcap"): "equipoise identify cut.mcap",
    ("log", "explain", "swing.csv"): "swing.csv",
    ("log", "show", "none.mcap"): "none.mcap",
    ("identify", "none.mcap"): "none.mcap",
    # Values
    ("train", "--episodes", "0"): "--episodes",
    ("train", "--target", "2"): "--target",
    ("train", "--recipe", "nope"): "robust",
    ("train", "--set", "learning.gama=1"): "learning.gama",
    ("train", "--arm", "ur5"): "iiwa7",
    ("train", "--world", "ideal"): "ideal",
    ("train", "--seed", "-1"): "--seed",
    ("evaluate", "--trials", "0"): "--trials",
    ("evaluate", "--duration", "nan"): "--duration",
    ("evaluate", "--world", "twin:nowhere"): "twin:nowhere",
    ("evaluate", "--claim", "1"): "probability",
    ("evaluate", "--claim", "0.99", "--trials", "10"): "299",
    ("evaluate", "--claim", "0.99", "--seed", "1"): "--seed",
    ("evaluate", "small.json", "--arm", "iiwa7"): "iiwa14",
    ("identify", "swing.csv", "--mass", "1"): "--length",
    ("identify", "swing.csv", "--mass", "1", "--length", "-1"): "--length",
    ("identify", "swing.csv", "--columns", "time_s"): "",
    ("play", "nowhere"): "nowhere",
    # The rig
    ("deploy", "--dry-run"): "--robot",
    ("deploy", "--rig", "rig.toml"): "--robot",
    ("deploy", "--encoder", BOARD): "--robot",
    ("deploy", "--excite", "--world", "model"): "twin:nominal",
    ("deploy", "small.json", "--excite"): "--excite",
    ("deploy", "--robot", KST): "--encoder",
    ("deploy", "--robot", "ros://host", "--encoder", BOARD): "kst:",
    ("deploy", "--robot", KST, "--encoder", "usb:///x"): "serial:",
    ("deploy", "--robot", KST, "--encoder", BOARD, "--actuator", "ideal"): "ideal",
    ("deploy", "--duration", "0"): "--duration",
    (*TWIN, "--excite"): "--excite",
    (*TWIN, "--encoder", BOARD): "--encoder",
    (*TWIN, "--world", "twin:harsh"): "--world",
    (*TWIN, "--rig", "none.toml"): "none.toml",
    (*TWIN, "--console"): "--console",
    ("deploy", "small.json", *TWIN[1:], "--anyway"): "iiwa14",
    ("rig", "doctor", "--robot", "twin:nominal"): "twin:nominal",
    ("rig", "doctor", "--seconds", "0"): "--seconds",
    ("rig", "record", "--out", "new.csv"): "--encoder",
    ("rig", "record", "--encoder", "/dev/tty", "--out", "new.csv"): "serial:",
    ("rig", "record", "--encoder", BOARD, "--duration", "0.5"): "--duration",
    ("rig", "emulate", "--world", "model"): "twin:nominal",
}


@pytest.fixture
def files(tmp_path, swing, policy_file, pendulum_file):
    (tmp_path / "taken.json").write_text("{}")
    (tmp_path / "rig.toml").write_text("arm = 'iiwa7'\n")
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    policy_file.rename(tmp_path / "small.json")
    pendulum_file.rename(tmp_path / "pen.json")
    (tmp_path / "cut.json").write_bytes((tmp_path / "small.json").read_bytes())
    cut(tmp_path / "cut.json")
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")


@pytest.mark.parametrize("arguments", REFUSED, ids=" ".join)
def test_bad_input_is_refused(files, refused, arguments):
    refused(*arguments, saying=REFUSED[arguments])


def test_a_missing_package_is_named(refused, files, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    refused("play", saying="needs the package viser")


def test_a_device_that_is_not_there_is_the_outside_world(equipoise, monkeypatch, tmp_path):
    monkeypatch.setattr("sys.stdin", None)
    for arguments in (
        ("deploy", "--robot", KST, "--encoder", BOARD),
        ("rig", "record", "--encoder", BOARD),
    ):
        ran = equipoise(*arguments)
        assert ran.code == 3
        assert "cannot open /dev/nowhere" in ran.err
        assert not list(tmp_path.iterdir())


def test_an_error_of_the_disk_leaves_nothing(equipoise, monkeypatch, tmp_path):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    ran = equipoise("evaluate", "--trials=1", "--duration=0.1", "--no-baselines")
    assert ran.code == 3
    assert "No space left on device" in ran.err
    assert not list(tmp_path.iterdir())
