"""A user's package outside the tree: it is built, installed and used as any other package is."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.program import run_program
from tests.test_pages import blocks

GUEST = Path(__file__).parent / "guest"

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder with the user's package, built from a copy and installed without a network."""
    site = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    command += ["--no-build-isolation", "--target", str(site), str(GUEST)]
    subprocess.run(command, check=True, timeout=120)
    assert (site / "equipoise_guest-1.0.dist-info" / "entry_points.txt").exists()
    return site


@pytest.fixture
def run(installed, tmp_path):
    """Run a program with the user's package, in a process and a folder of its own."""
    paths = [str(installed), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}

    def run(*arguments):
        options = {"cwd": tmp_path, "env": environment, "timeout": 600}
        ran = run_program(sys.executable, *arguments, check=False, **options)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return ran

    return run


def equipoise(run, *arguments):
    return json.loads(run("-m", "equipoise", *arguments, "--json").stdout)


BLOCKS = blocks("docs/how-to/bring-a-robot.md", "python", "toml", "sh")
(CONFORMANCE,) = (block for _, block in BLOCKS if "RobotConformance" in block)


def test_its_robot_passes_the_conformance_suite_as_the_page_prints_it(run, tmp_path):
    (tmp_path / "test_robot.py").write_text(CONFORMANCE)
    ran = run("-m", "pytest", "-q", "-p", "no:cacheprovider", "test_robot.py")
    assert "12 passed" in ran.stdout


def plain(text):
    """The lines without indentation and empty ones, which a formatter of pages sets as it likes."""
    return "\n".join(line.strip() for line in text.splitlines() if line.strip())


def test_the_page_shows_this_package_whose_robot_balances_over_its_own_wires(run):
    files = [path.read_text() for path in GUEST.rglob("*.*") if path.suffix in (".py", ".toml")]
    code = [block for kind, block in BLOCKS if kind != "sh" and not block.startswith(">>>")]
    assert len(code) == 4
    for block in code:
        assert any(plain(block) in plain(text) for text in (*files, CONFORMANCE)), block
    (commands,) = (block for kind, block in BLOCKS if kind == "sh")
    deploy, explain = (shlex.split(command)[1:] for command in commands.splitlines())
    told = equipoise(run, *deploy)
    assert (told["outcome"], told["missed"]) == ("survived", 0)
    assert told["survival_s"] == pytest.approx(5.0, abs=0.02)
    stood = equipoise(run, *explain)
    assert stood["outcome"] == "survived"
    assert 0.0 < stood["phi_deg"]["rms"] < stood["phi_deg"]["largest"] < stood["phi_deg"]["limit"]


def test_its_algorithm_reward_and_policy_need_no_more_than_their_names(run, tmp_path):
    trained = ("--algorithm", "guest.algorithm:algorithm", "--reward", "guest.reward:middle")
    budget = ("--episodes", 300, "--target", 0, "--out", "policy.json")
    equipoise(run, "train", *trained, *budget)
    learning = json.loads((tmp_path / "policy.json").read_text())["body"]["settings"]["learning"]
    assert re.fullmatch(r"guest\.algorithm:algorithm@[0-9a-f]{16}", learning["algorithm"])
    assert re.fullmatch(r"guest\.reward:middle@[0-9a-f]{16}", learning["reward"])
    trials = ("--trials", 4, "--duration", 5, "--world", "twin:nominal", "--no-baselines")
    assert equipoise(run, "evaluate", "guest.policy:Policy", *trials)["rate"] == 1.0
