"""After a warm-up no verb compiles anything."""

import subprocess
import sys

import pytest

VERBS = [
    ["train", "--set", "learning.episodes=100", "--target", "0"],
    ["evaluate", "--trials", "2", "--duration", "1"],
    ["evaluate", "--trials", "2", "--duration", "1", "--world", "twin:harsh", "--out", "e.json"],
    ["deploy", "--duration", "1"],
]
WATCH = """
import sys
from equipoise.jit import watching_compilation
from equipoise.cli import main
compiled = []
with watching_compilation(compiled.append):
    code = main(sys.argv[1:])
sys.exit(code not in (0, 1) or len(compiled))
"""


@pytest.mark.full
def test_after_a_warm_up_no_verb_compiles(tmp_path, monkeypatch):
    monkeypatch.setenv("EQUIPOISE_CACHE_DIR", str(tmp_path / "cache"))
    warm = [sys.executable, "-m", "equipoise", "warm-up"]
    subprocess.run(warm, check=True, cwd=tmp_path)
    for verb in VERBS:
        subprocess.run([sys.executable, "-c", WATCH, *verb], check=True, cwd=tmp_path)
