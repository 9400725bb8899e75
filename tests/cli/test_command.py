"""The command as a whole: help, imports, exit codes, interruption, and streams that are closed."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import version

import pytest

from equipoise.cli.output import Output
from equipoise.worlds.evaluation import Evaluation
from tests.cli.conftest import verbs

HEAVY = ("numba", "numpy", "scipy", "mujoco", "matplotlib", "mcap")
COMMAND = (sys.executable, "-m", "equipoise")


def test_help_names_every_verb_and_explains_every_option(equipoise):
    for verb, command in verbs().items():
        *group, name = verb.split()
        assert f" {name} " in equipoise(*group, "--help").out
        ran = equipoise(*verb.split(), "--help")
        assert ran.code == 0
        options = [one for one in command.params if one.param_type_name == "option"]
        assert all(one.help for one in options), verb
    assert equipoise("--version").out == f"equipoise {version('equipoise')}\n"
    wrong = equipoise("idnetify")
    assert wrong.code == 2
    assert "Did you mean 'identify'" in wrong.err


def test_help_waits_for_nothing_that_is_slow_to_import():
    program = f"""
from equipoise.cli import main
main(['train', '--help'])
import sys
print([name for name in {HEAVY} if name in sys.modules])
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert ran.stdout.endswith("\n[]\n")


def test_a_result_is_text_or_one_object(capsys):
    fields = {
        "median_s": 1.5,
        "unknown": None,
        "infinite": float("inf"),
        "interval": (0.25, 0.75),
        "rows": {"LQR": {"survived": 3}, "PD": {"survived": 0}},
        "warnings": ["look out"],
    }
    Output(as_json=False).result(**fields)
    text = capsys.readouterr().out
    assert "warning: look out" in text
    assert "unknown" not in text
    assert "median [s] 1.5" in " ".join(text.split())
    Output(as_json=True).result(**fields)
    found = json.loads(capsys.readouterr().out)
    assert found == fields | {"infinite": None, "interval": [0.25, 0.75]}


@pytest.mark.full
@pytest.mark.compiled_only
def test_ctrl_c_ends_work_on_threads_and_leaves_no_file(tmp_path):
    process = subprocess.Popen(
        [*COMMAND, "evaluate", "--trials", "100000"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(5.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    assert (process.returncode, out) == (130, "")
    assert err.endswith("interrupted\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no full device")
def test_a_full_disk_is_told_in_one_sentence_and_a_closed_pipe_silently():
    arguments = ("log", "explain", "--help")
    with open("/dev/full", "w") as full:
        ran = subprocess.run(
            [*COMMAND, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert ran.returncode == 3
    assert ran.stderr.startswith("error: ")
    assert "No space left on device" in ran.stderr
    assert ran.stderr.count("\n") == 1
    read, write = os.pipe()
    os.close(read)
    ran = subprocess.run(
        [*COMMAND, *arguments], stdout=write, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(write)
    assert (ran.returncode, ran.stderr) == (141, "")


@pytest.mark.compiled_only
@pytest.mark.skipif(os.name != "posix", reason="the shell closes streams")
def test_a_verb_works_with_closed_streams(tmp_path):
    words = "evaluate --trials=2 --duration=0.5 --no-baselines --out=found.json"
    ran = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m equipoise {words} <&- >&- 2>&-"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, ran.stdout) == (0, "")
    assert len(Evaluation.load(tmp_path / "found.json").results.survival) == 2
