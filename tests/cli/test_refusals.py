"""Bad input: exit code 2 and one sentence before the work begins, and no file."""

import pytest

KST, BOARD = "kst://127.0.0.1:9", "serial:///dev/nowhere"
TWIN = ("deploy", "--robot", "twin:nominal")

REFUSED = {
    # Names of files
    ("evaluate", "none.json"): "none.json",
    ("evaluate", "--out", "x.txt"): "ends in .json",
    ("evaluate", "small.json", "--out", "small.json", "--force"): "is read",
    ("evaluate", "--out", "taken.json"): "--force",
    # A missing input comes first: nothing would be written.
    ("identify", "none.csv", "--out", "taken.json"): "none.csv",
    ("reproduce", "--swing", "none.csv", "--out", "full"): "none.csv",
    ("refine", "small.json", "none.mcap", "--out", "taken.json"): "none.mcap",
    ("reproduce", "--out", "full"): "--force",
    # Kinds of files
    ("evaluate", "pen.json"): "equipoise-policy",
    # Values
    ("train", "--episodes", "0"): "--episodes",
    ("train", "--set", "learning.gama=1"): "learning.gama",
    ("train", "--arm", "ur5"): "iiwa7",
    ("evaluate", "--duration", "nan"): "--duration",
    ("evaluate", "--claim", "0.99", "--trials", "10"): "give 1000",
    ("evaluate", "small.json", "--arm", "iiwa7"): "iiwa14",
    ("identify", "swing.csv", "--mass", "1"): "--length",
    ("play", "nowhere"): "nowhere",
    ("evaluate", "--world", "nominal", "--out", "new.json"): "did you mean twin:nominal?",
    ("evaluate", "--world", "twin:w\udcff.toml"): "not UTF-8",
    ("evaluate", "--actuator", "none.json"): "none.json",
    # A wrong word comes before the name of a file.
    ("train", "--algorithm", "sarsaa", "--out", "taken.json"): "unknown algorithm 'sarsaa'",
    ("train", "--reward", "nope", "--out", "taken.json"): "unknown reward 'nope'",
    ("deploy", "--excite", "--world", "frii"): "did you mean twin:fri?",
    ("deploy", "--robot", KST, "--encoder", "usb:///x", "--out", "taken.mcap"): "serial:",
    ("rig", "record", "--encoder", "usb:///x", "--out", "swing.csv"): "serial:",
    # The rig
    ("deploy", "--dry-run"): "--robot",
    ("deploy", "--runs", "3"): "--robot",
    (*TWIN, "--runs", "3"): "--start hanging",
    ("deploy", "small.json", "--excite"): "--excite",
    ("deploy", "--robot", KST): "--encoder",
    ("deploy", "--robot", KST, "--encoder", BOARD, "--actuator", "ideal"): "ideal",
    (*TWIN, "--excite"): "--excite",
    ("rig", "doctor", "--robot", "twin:nominal"): "twin:nominal",
    ("rig", "record", "--out", "new.csv"): "--encoder",
}


@pytest.fixture
def files(tmp_path, swing, policy_file, pendulum_file):
    (tmp_path / "taken.json").write_text("{}")
    (tmp_path / "taken.mcap").write_text("")
    (tmp_path / "w\udcff.toml").write_text("")
    policy_file.rename(tmp_path / "small.json")
    pendulum_file.rename(tmp_path / "pen.json")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")


@pytest.mark.parametrize("arguments", REFUSED, ids=" ".join)
def test_bad_input_is_refused(files, refused, arguments):
    refused(*arguments, saying=REFUSED[arguments])


@pytest.mark.full
def test_a_device_that_is_not_there_is_the_outside_world(equipoise, monkeypatch, tmp_path):
    monkeypatch.setattr("sys.stdin", None)
    for arguments in (
        ("deploy", "--robot", KST, "--encoder", BOARD),
        ("rig", "record", "--encoder", BOARD),
    ):
        assert "cannot open /dev/nowhere" in equipoise(*arguments, code=3).err
        assert not list(tmp_path.iterdir())
