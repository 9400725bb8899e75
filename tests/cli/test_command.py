"""The command as a whole: help, imports, exit codes, interruption, and streams that are closed."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from importlib.metadata import version

import pytest

from equipoise.cli.options import TABLES
from equipoise.cli.output import Output
from equipoise.simulation.evaluation import Evaluation
from tests.cli.conftest import verbs
from tests.program import run_program, start_program

HEAVY = ("numba", "numpy", "scipy", "mujoco", "matplotlib", "mcap")
COMMAND = (sys.executable, "-m", "equipoise")


def test_help_names_every_verb_and_explains_every_option(equipoise):
    for verb, command in verbs().items():
        *group, name = verb.split()
        assert f" {name} " in equipoise(*group, "--help").out
        equipoise(*verb.split(), "--help")
        options = [one for one in command.params if one.param_type_name == "option"]
        assert all(one.help for one in options), verb
    assert equipoise("--version").out == f"equipoise {version('equipoise')}\n"
    assert "Did you mean 'identify'" in equipoise("idnetify", code=2).err


def test_help_names_every_entry_of_the_tables_that_an_option_takes(equipoise, monkeypatch):
    from equipoise.console.play import SCENES
    from equipoise.control.bound_policy import BUILT_IN

    tables = {**TABLES, "scenes": SCENES, "policies": BUILT_IN, "robots": {"kst", "twin"}}
    listed = {
        "train": "rewards recipes worlds arms",
        "evaluate": "worlds arms policies",
        "deploy": "worlds arms robots",
        "rig emulate": "worlds arms",
        "reproduce": "recipes arms",
        "identify": "frictions",
        "play": "scenes",
    }
    monkeypatch.setenv("COLUMNS", "80")
    for verb in verbs():
        text = equipoise(*verb.split(), "--help").out
        assert not re.search(r"Annotated|FieldInfo|\{[a-z]|…", text), verb
        for table in listed.get(verb, "").split():
            assert set(tables[table]) <= set(re.findall(r"[\w-]*\w", text)), (verb, table)


def test_help_waits_for_nothing_that_is_slow_to_import():
    program = f"""
from equipoise.cli import main
main(['train', '--help'])
import sys
print([name for name in {HEAVY} if name in sys.modules])
"""
    assert run_program(sys.executable, "-c", program).stdout.endswith("\n[]\n")


def test_a_result_is_text_or_one_object(capsys):
    fields = {
        "median_s": 1.5,
        "unknown": None,
        "infinite": float("inf"),
        "interval": (0.25, 0.75),
        "rows": {"LQR": {"survived": 3}, "PD": {"survived": 0}},
        "warnings": ["look out"],
    }
    Output(as_json=False).result(**fields, then="evaluate POLICY")
    text = capsys.readouterr().out
    assert "warning: look out" in text
    assert "unknown" not in text
    lines = [" ".join(line.split()) for line in text.splitlines()]
    for line in ("median [s] 1.5", "interval 0.25 to 0.75", "rows survived", "LQR 3", "PD 0"):
        assert line in lines
    Output(as_json=True).result(**fields)
    found = json.loads(capsys.readouterr().out)
    assert found == fields | {"infinite": None, "interval": [0.25, 0.75]}


@pytest.mark.parametrize("columns", [80, 200])
def test_no_column_is_cut_however_narrow_the_terminal(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    figures = {"survived": 190, "trials": 200, "interval_95": (0.912, 0.975), "median_s": 59.875}
    rows = {"LQR, snapped": figures, "random": figures | {"outcomes": {"angle": 188, "track": 2}}}
    Output(as_json=False).result(**figures, baselines=rows)
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= columns
    assert "…" not in text
    words = text.split()
    for word in ("190", "0.912", "0.975", "59.88", "random"):
        assert words.count(word) == (1 if word == "random" else 3)


def test_a_log_file_shows_that_kernels_were_compiled(monkeypatch, capsys):
    @contextmanager
    def compiles_two(count):
        count("one")
        count("two")
        yield

    monkeypatch.setattr("equipoise.jit.watching_compilation", compiles_two)
    with Output(as_json=False).progress() as show:
        show("train")
        show("train", 1.0)
    lines = [line for line in capsys.readouterr().err.splitlines() if "compile" in line]
    assert len(lines) == 1
    assert "100%" in lines[0]


@pytest.mark.full
def test_ctrl_c_ends_work_on_threads_and_leaves_no_file(tmp_path):
    process = start_program(*COMMAND, "evaluate", "--trials", "100000", cwd=tmp_path)
    time.sleep(5.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    assert (process.returncode, out) == (130, "")
    assert err.endswith("interrupted\n")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_told_in_one_sentence_and_a_closed_pipe_silently():
    command = [*COMMAND, "log", "explain", "--help"]
    options = {"stderr": subprocess.PIPE, "text": True, "check": False}
    with open("/dev/full", "w") as full:
        ran = subprocess.run(command, stdout=full, **options)
    assert ran.returncode == 3
    assert ran.stderr.startswith("error: ")
    assert "No space left on device" in ran.stderr
    assert ran.stderr.count("\n") == 1
    read, write = os.pipe()
    os.close(read)
    ran = subprocess.run(command, stdout=write, **options)
    os.close(write)
    assert (ran.returncode, ran.stderr) == (141, "")


def test_a_verb_works_with_closed_streams(tmp_path):
    words = "evaluate --trials=2 --duration=0.5 --no-baselines --out=found.json"
    line = f"{sys.executable} -m equipoise {words} <&- >&- 2>&-"
    ran = run_program("sh", "-c", line, cwd=tmp_path, check=False)
    assert (ran.returncode, ran.stdout) == (0, "")
    assert "Traceback" not in ran.stderr
    assert len(Evaluation.load(tmp_path / "found.json").results.survival) == 2


@pytest.mark.parametrize("error", [OSError(5, "Input/output error", "swing.csv"), TimeoutError()])
def test_an_error_of_the_system_is_not_blamed_on_the_output(equipoise, monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("equipoise.read_swing", fail)
    ran = equipoise("identify", "swing.csv", code=3)
    assert ran.err == f"error: a file or a link failed: {error}; check it, and repeat the command\n"
    assert ran.out == ""
