"""The wheel: built from the sources, installed into an empty environment, and run there."""

import json
import subprocess
import sys
import venv
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.compiled_only
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_what_is_built_installs_and_reproduces_the_paper(kind, tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", tmp_path]
    subprocess.run(build, cwd=SOURCES, check=True)
    (built,) = tmp_path.glob("equipoise-*")
    venv.create(tmp_path / "empty", with_pip=True)
    run = {"cwd": tmp_path, "check": True, "env": {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}}
    subprocess.run([tmp_path / "empty/bin/pip", "install", "--quiet", built], **run)
    command = [tmp_path / "empty/bin/equipoise", "reproduce", "--quick", "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, **run)
    medians = json.loads(done.stdout)["comparison"]["robot_or_twin_median_s"]
    assert medians["default recipe"] > medians["paper's robot"]
    assert (tmp_path / "equipoise-report" / "report.html").exists()
