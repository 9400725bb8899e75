"""A disk or a terminal that takes no more: one sentence and exit code 3. A closed pipe: silence."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no full device")


def run(*arguments, **streams):
    command = [sys.executable, "-m", "equipoise", *arguments]
    return subprocess.run(command, text=True, check=False, **streams)


@pytest.mark.parametrize(
    "arguments",
    [("--help",), ("log", "explain", "nowhere.mcap"), ("rig", "doctor", "--json")],
)
def test_a_full_standard_output_is_told_in_one_sentence(arguments):
    with open("/dev/full", "w") as full:
        ran = run(*arguments, stdout=full, stderr=subprocess.PIPE)
    assert ran.returncode == 3
    assert ran.stderr == (
        "error: cannot write to standard output: No space left on device; make room, or send it "
        "elsewhere\n"
    )


def test_a_full_standard_error_leaves_the_exit_code():
    with open("/dev/full", "w") as full:
        ran = run("log", "explain", "nowhere.mcap", stdout=subprocess.PIPE, stderr=full)
    assert ran.returncode == 2
    assert ran.stdout == "Explaining nowhere.mcap\n"


@pytest.mark.parametrize("arguments", [("--help",), ("log", "explain", "nowhere.mcap")])
def test_a_closed_pipe_ends_a_verb_silently(arguments):
    # As a program that SIGPIPE ended: 1 would be a bad result.
    read, write = os.pipe()
    os.close(read)
    ran = run(*arguments, stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (ran.returncode, ran.stderr) == (141, "")
