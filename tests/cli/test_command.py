"""The command as a whole: help, version, first words, and what a shell sees."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.cli.conftest import verbs

VERBS = tuple(verbs())
PIPELINE = ("reproduce", "identify", "train", "evaluate", "refine")
RIG = ("doctor", "emulate", "record")
LOG = ("show", "explain", "export")
NEEDS = {
    "identify": ["x.csv"],
    "refine": ["policy.json", "run.mcap"],
    "log show": ["x.mcap"],
    "log explain": ["x.mcap"],
    "log export": ["x.mcap"],
    "rig record": ["--encoder", "serial:///dev/ttyACM0"],
}
"""Required arguments of a verb."""
HEAVY = ("numba", "numpy", "scipy", "mujoco", "matplotlib", "mcap")


def test_help_shows_the_verbs_in_their_panels(equipoise):
    ran = equipoise("--help")
    assert ran.code == 0
    pipeline, rest = ran.out.split("Pipeline")[1].split("The robot")
    robot, logs = rest.split("Logs")
    assert all(f" {verb} " in pipeline for verb in PIPELINE)
    assert all(f" {verb} " in robot for verb in ("deploy", "rig"))
    assert " log " in logs
    for group, members in (("rig", RIG), ("log", LOG)):
        assert all(f" {verb} " in equipoise(group, "--help").out for verb in members)
        # Without a verb a group shows its help, like the command itself.
        assert f"Usage: equipoise {group}" in equipoise(group).out


@pytest.mark.parametrize("verb", VERBS)
def test_each_option_of_a_verb_is_explained(equipoise, verb):
    ran = equipoise(*verb.split(), "--help")
    assert ran.code == 0
    # On the wide page each option stands on a line of its own, its text at the end.
    lines = [line for line in ran.out.splitlines() if line.startswith("│ ") and "--" in line]
    assert lines
    assert all(line.strip("│ ")[-1] in ".]" for line in lines), lines


def test_no_verb_shows_the_help_and_a_wrong_one_a_hint(equipoise):
    assert "Usage: equipoise" in equipoise().out
    wrong = equipoise("idnetify")
    assert wrong.code == 2
    assert "Did you mean 'identify'" in wrong.err


def test_version_is_the_packages(equipoise):
    assert equipoise("--version").out == f"equipoise {version('equipoise')}\n"


@pytest.mark.parametrize(
    ("words", "completed"),
    [("rig d", ["doctor"]), ("log ex", ["explain", "export"]), ("evaluate --cl", ["--claim"])],
)
def test_a_shell_completes_verbs_and_options(words, completed):
    asked = {"COMP_WORDS": f"equipoise {words}", "COMP_CWORD": "2"}
    ran = subprocess.run(
        [sys.executable, "-m", "equipoise"],
        env=os.environ | asked | {"_EQUIPOISE_COMPLETE": "complete_bash"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.stdout.split() == completed, ran


def loaded_after(program):
    """Return which heavy packages a fresh Python has loaded after `program`."""
    tail = f"\nimport sys, json; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-c", program + tail], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def test_help_waits_for_nothing_that_is_slow_to_import():
    assert loaded_after("from equipoise.cli import main; main(['--help'])") == []
    assert loaded_after("from equipoise.cli import main; main(['train', '--help'])") == []


@pytest.mark.parametrize(
    "verb",
    [
        verb if verb in ("train", "deploy", "play") else pytest.param(verb, marks=pytest.mark.slow)
        for verb in VERBS
    ],
)
def test_the_first_words_come_before_what_is_slow_to_import(verb):
    # The word stops the verb: all that it imported so far is what its user waited for.
    program = f"""
from equipoise.cli import main, output
def first_words(self, words, **_):
    assert words
    raise SystemExit(0)
output.Output.say = first_words
main([*{verb.split()}, *{NEEDS.get(verb, [])}])
"""
    assert loaded_after(program) == []


def test_python_m_and_exit_codes_reach_the_shell(tmp_path):
    command = [sys.executable, "-m", "equipoise", "log", "explain", "nowhere.mcap"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "error: there is no file nowhere.mcap; check the path\n"
    assert done.stdout == "Explaining nowhere.mcap\n"


def test_the_reference_page_has_every_option():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "command-line.md").read_text()
    sections = {section.split("\n")[0]: section for section in page.split("\n## ")}
    for verb, command in verbs().items():
        options = {
            option
            for parameter in command.params
            for option in (*parameter.opts, *parameter.secondary_opts)
            if option.startswith("--") and option != "--help"
        }
        assert "--json" in options
        assert {option for option in options if f"`{option}`" not in sections[verb]} == set()


@pytest.mark.skipif(sys.platform == "win32", reason="no limits on the address space")
def test_little_address_space_is_refused_in_one_sentence(swing):
    import resource

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (600 * 2**20,) * 2)

    ran = subprocess.run(
        [sys.executable, "-m", "equipoise", "identify", str(swing)],
        preexec_fn=limited,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 3
    assert "limited to 600 MiB, expected 1024 MiB or more" in ran.stderr
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize(
    ("name", "text"),
    [("SOURCE_DATE_EPOCH", text) for text in ("x", "", "-1", "1e9", "9" * 12, "١")]
    + [("NUMBA_NUM_THREADS", text) for text in ("x", "0", "-1")],
)
def test_a_variable_that_libraries_cannot_read_is_refused(equipoise, monkeypatch, name, text):
    monkeypatch.setenv(name, text)
    ran = equipoise("log", "explain", "nowhere.mcap")
    assert ran.code == 2
    assert f"error: {name} is {text!r}, expected" in ran.err
