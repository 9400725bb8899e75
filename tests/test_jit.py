"""Compilation and its cache, each case in a process of its own."""

import os
import re
import sys

import pytest

from tests.program import run_program

MODULE = """
from equipoise.jit import kernel

@kernel
def double(x):
    return FACTOR * x

def triple(x, out):
    out[0] = 3.0 * x
"""
SESSION = """
import os, sys
if room := os.environ.get("ROOM"):
    import shutil
    shutil.disk_usage = lambda _: shutil._ntuple_diskusage(0, 0, int(room))
sys.path.insert(0, sys.argv[1])
import numba, numpy as np
from equipoise import jit
from tried import double, triple

out = np.zeros(1)
address = jit.pointer(triple, 0.0, np.zeros(1))

@jit.kernel
def through(address, x, out):
    jit.call(address, (x, out))

through(address, 2.0, out)
four = double(2.0)
hits = "plain" if double is getattr(double, "py_func", double) else sum(
    double.stats.cache_hits.values())
print(four, out[0], hits)
"""


def session(folder, factor="2.0", **environment):
    """Run the session above; return four, six, its cache hits, and what it warns of."""
    (folder / "tried.py").write_text(MODULE.replace("FACTOR", factor))
    (folder / "session.py").write_text(SESSION)
    env = {**os.environ, "EQUIPOISE_CACHE_DIR": str(folder / "cache"), **environment}
    run = run_program(sys.executable, folder / "session.py", folder, env=env, timeout=300)
    return run.stdout.split(), run.stderr


@pytest.mark.full
def test_machine_code_is_found_again_unless_its_file_changed(tmp_path):
    assert session(tmp_path) == (["4.0", "6.0", "0"], "")
    assert (tmp_path / "cache").stat().st_mode & 0o077 == 0  # loading cached code runs it
    assert session(tmp_path) == (["4.0", "6.0", "1"], "")
    assert session(tmp_path, factor="5.25") == (["10.5", "6.0", "0"], "")


@pytest.mark.parametrize(
    ("environment", "reason"),
    [({"EQUIPOISE_CACHE_DIR": __file__}, "File exists"), ({"ROOM": "1000000"}, "1 MB are free")],
)
@pytest.mark.full
def test_a_cache_that_takes_no_code_gives_one_warning_and_right_results(
    tmp_path, environment, reason
):
    told, warning = session(tmp_path, **environment)
    assert told == ["4.0", "6.0", "0"]
    assert warning.count("cannot write the cache") == 1
    assert f"({reason})" in warning


def test_without_compilation_kernels_are_plain_functions(tmp_path):
    assert session(tmp_path, NUMBA_DISABLE_JIT="1")[0] == ["4.0", "6.0", "plain"]
    assert not (tmp_path / "cache").exists()


def test_the_key_of_the_cache_changes_with_the_files_that_kernels_depend_on(tmp_path, monkeypatch):
    from equipoise import jit

    monkeypatch.setattr(jit, "PACKAGE", tmp_path)
    for package in ("simulation/twin", "control", "cli"):
        (tmp_path / package).mkdir(parents=True)
    seen = set()
    for name, text in (
        ("jit.py", ""),
        ("simulation/twin/a.py", ""),
        ("simulation/twin/a.py", "x = 1"),
        ("control/a.py", "x = 1"),
    ):
        (tmp_path / name).write_text(text)
        seen.add(jit.package_digest.__wrapped__())
    assert len(seen) == 4
    for name in ("settings.py", "control/notes.txt", "cli/help.py"):
        (tmp_path / name).write_text("no kernel")
        assert jit.package_digest.__wrapped__() in seen


def test_every_kernel_is_in_a_file_of_the_key():
    from equipoise import jit

    named = {file for pattern in jit.KERNEL_FILES for file in jit.PACKAGE.glob(pattern)}
    word = r"@(kernel|inlined|compilable)\b|\b(pointer|kernel)\("
    holding = {file for file in jit.PACKAGE.rglob("*.py") if re.search(word, file.read_text())}
    assert len(holding) > 10
    assert holding <= named
