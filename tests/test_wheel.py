"""What is built from the sources: the same in a wheel and in an archive, and it runs elsewhere."""

import json
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

SOURCES = Path(__file__).parents[1]


def build(sources, kind, folder):
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", folder]
    subprocess.run(command, cwd=sources, check=True)
    (built,) = folder.glob("equipoise*")
    return built


@pytest.mark.full
@pytest.mark.parametrize("sources", [SOURCES, SOURCES / "plugins" / "equipoise-franka"])
def test_the_wheel_of_the_archive_is_the_wheel_of_the_sources(sources, tmp_path):
    shutil.unpack_archive(build(sources, "sdist", tmp_path / "archive"), tmp_path / "unpacked")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    wheels = [build(of, "wheel", tmp_path / of.name) for of in (sources, unpacked)]
    ours, theirs = ({i.filename: i.CRC for i in ZipFile(wheel).infolist()} for wheel in wheels)
    assert ours == theirs


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_what_is_built_installs_and_reproduces_the_paper(kind, tmp_path):
    built = build(SOURCES, kind, tmp_path / "built")
    venv.create(tmp_path / "empty", with_pip=True)
    run = {"cwd": tmp_path, "check": True, "env": {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}}
    subprocess.run([tmp_path / "empty/bin/pip", "install", "--quiet", built], **run)
    command = [tmp_path / "empty/bin/equipoise", "reproduce", "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, **run)
    medians = json.loads(done.stdout)["comparison"]["robot_or_twin_median_s"]
    assert medians["default recipe"] > medians["paper's robot"]
    assert (tmp_path / "equipoise-report" / "report.html").exists()
