"""Names of files that a verb writes: kept, refused or replaced, and claimed by one writer alone."""

import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output
from equipoise.errors import InputError, OutsideError


def picture(path):
    return (path.with_suffix(".png"),)


@pytest.fixture
def choose(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def file(given=None, *inputs, force=False, beside=picture, **options):
        return choose_file(
            Output(True), given, "pendulum.json", *inputs, force=force, beside=beside, **options
        )

    return file


def test_a_default_name_that_exists_gets_the_next_free_number(choose, tmp_path):
    assert str(choose().path) == "pendulum.json"
    (tmp_path / "pendulum.json").touch()
    assert str(choose().path) == "pendulum-2.json"
    # A file beside it carries the same number, so it takes the number, too.
    (tmp_path / "pendulum-2.png").touch()
    assert str(choose().path) == "pendulum-3.json"
    assert str(choose(force=True).path) == "pendulum.json"
    # A link that leads nowhere is a name, too.
    (tmp_path / "pendulum-3.json").symlink_to("nowhere")
    assert str(choose().path) == "pendulum-4.json"


def test_a_default_name_that_is_read_is_kept_but_not_replaced(choose, tmp_path):
    path = tmp_path / "pendulum.json"
    path.touch()
    assert str(choose(None, path).path) == "pendulum-2.json"
    with pytest.raises(InputError, match="is read and would be written over"):
        choose(None, path, force=True)


def test_a_given_name_that_exists_is_refused_by_name(choose, tmp_path):
    mine, its_picture = tmp_path / "mine.json", tmp_path / "mine.png"
    assert choose(mine).path == mine
    its_picture.touch()
    with pytest.raises(InputError, match=r"mine\.png exists; give another --out, or --force"):
        choose(mine)
    assert choose(mine, force=True).path == mine
    assert choose(mine, beside=lambda _: ()).path == mine


@pytest.mark.parametrize("name", ["x" * 300 + ".json", "ä" * 126 + ".json"])
def test_a_name_that_the_file_system_does_not_take_is_refused(choose, tmp_path, name):
    with pytest.raises(InputError, match="File name too long"):
        choose(tmp_path / name)


@pytest.mark.parametrize("name", [".", "..", "/", "folder.json/", "a.json/b.json"])
def test_a_name_that_cannot_be_a_file_is_refused(choose, tmp_path, name):
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "a.json").touch()
    with pytest.raises(InputError, match="give"):
        choose(type(tmp_path)(name))


def test_writers_that_start_at_once_get_names_of_their_own(choose, tmp_path):
    # All have chosen the same name before the first of them writes.
    chosen = [choose() for _ in range(12)]

    def write(destination, text):
        with destination.claimed() as path:
            path.write_text(text)
            picture(path)[0].write_text(text)
        return path

    with ThreadPoolExecutor(12) as pool:
        paths = list(pool.map(write, chosen, map(str, range(12))))
    assert len(set(paths)) == 12
    for number, path in enumerate(paths):
        assert path.read_text() == picture(path)[0].read_text() == str(number)


def test_a_claim_leaves_nothing_that_was_not_written(choose, tmp_path):
    with choose().claimed() as path:
        path.write_text("written, without a picture")
    assert os.listdir(tmp_path) == ["pendulum.json"]
    with pytest.raises(KeyboardInterrupt), choose().claimed():
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == ["pendulum.json"]


def test_a_disk_that_fills_up_between_two_files_leaves_the_first(choose, tmp_path):
    full = pytest.raises(OutsideError, match=r"^full; pendulum\.json was written before$")
    with full, choose().claimed() as path:
        path.write_text("a study of an hour")
        raise OutsideError("full")
    assert os.listdir(tmp_path) == ["pendulum.json"]


def test_a_forced_claim_keeps_the_old_file_until_there_is_a_new_one(choose, tmp_path):
    old = tmp_path / "pendulum.json"
    old.write_text("old")
    with pytest.raises(KeyboardInterrupt), choose(force=True).claimed():
        raise KeyboardInterrupt
    assert old.read_text() == "old"
    assert os.listdir(tmp_path) == ["pendulum.json"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_became_read_only_is_told(choose, tmp_path):
    chosen = choose()
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OutsideError, match=r"cannot write pendulum\.json"), chosen.claimed():
            pass
    finally:
        tmp_path.chmod(0o700)


def test_folders_follow_the_same_rule(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def choose(given=None, force=False):
        return choose_file(Output(True), given, "report", force=force, suffix="")

    with choose().claimed() as folder:
        assert str(folder) == "report"
    assert not folder.exists(), "nothing was written"
    folder.mkdir()
    assert str(choose().path) == "report", "an empty folder is free"
    (folder / "page.html").touch()
    # A dot in a folder's name begins no suffix.
    assert str(choose().path) == "report-2"
    (tmp_path / "v1.2").mkdir()
    (tmp_path / "v1.2" / "page.html").touch()
    with pytest.raises(InputError, match=r"v1\.2 exists and is not empty; give another --out"):
        choose(tmp_path / "v1.2")
    with choose(force=True).claimed() as folder:
        assert str(folder) == "report"
    assert (folder / "page.html").exists()
    with pytest.raises(InputError, match="File name too long"):
        choose(tmp_path / LONG)
    with pytest.raises(InputError, match="is a file"):
        choose(folder / "page.html")


LONG = "x" * 300
VERBS = {
    "identify": (("swing.csv",), ".json"),
    "train": ((), ".json"),
    "evaluate": ((), ".json"),
    "deploy": ((), ".mcap"),
    "rig record": (("--encoder", "serial:///dev/nowhere"), ".csv"),
    "evaluate --claim 0.9": ((), ".json"),
    "refine": (("policy.json", "run.mcap"), ".json"),
    "reproduce": ((), ""),
}
"""What a verb needs besides `--out`, and how the name of its result ends."""


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_refuses_a_name_that_cannot_be_written_before_it_works(refused, verb):
    needs, suffix = VERBS[verb]
    refused(*verb.split(), *needs, "--out", LONG + suffix, saying="File name too long")
    if suffix:
        refused(*verb.split(), *needs, "--out", ".", saying=f"give a name that ends in {suffix}")


READING = (
    ("identify", f"{LONG}.csv"),
    ("identify", f"{LONG}.mcap"),
    ("train", f"{LONG}.json"),
    ("train", "--arm", f"{LONG}.urdf"),
    ("train", "--settings", f"{LONG}.toml"),
    ("train", "--actuator", f"{LONG}.json"),
    ("evaluate", f"{LONG}.json"),
    ("evaluate", "--world", f"twin:{LONG}.toml"),
    ("evaluate", "--policy", f"{LONG}:name"),
    ("deploy", "--robot", "twin:nominal", "--rig", f"{LONG}.toml"),
    ("deploy", "--video", f"{LONG}.mp4"),
    ("refine", f"{LONG}.json", "run.mcap"),
    ("log", "explain", f"{LONG}.mcap"),
    ("log", "export", f"{LONG}.mcap"),
    ("reproduce", "--swing", f"{LONG}.csv"),
)


@pytest.mark.parametrize("command", READING, ids=lambda command: " ".join(command)[:30])
def test_every_verb_refuses_a_name_that_is_too_long_to_read(refused, command):
    refused(*command, saying=LONG[:20])
