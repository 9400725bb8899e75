"""What the documented verbs write in the root of a checkout, git does not offer to commit."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.cli.conftest import verbs

ROOT = Path(__file__).parents[2]
WRITTEN = {
    "reproduce": ("equipoise-report/report.html",),
    "identify": ("pendulum.json", "pendulum.svg", "pendulum.png", "actuator.json"),
    "train": ("policy.json", "policy.partial.json"),
    "evaluate": (
        "evaluation.json",
        "evaluation.partial.json",
        "certificate.json",
        "certificate-evaluation.json",
    ),
    "deploy": ("run.mcap", "log.mcap", "run.mp4"),
    "rig record": ("swing.csv",),
    "refine": ("refined.json", "refined-pendulum.json"),
    "log export": ("run-csv/tick.csv", "run.mp4", "fall.mp4", "fall.webp", "release.webp"),
}
"""Files by verb, under default names and those of the documents."""
OTHERS = (".policy.json.12.34.tmp", "equipoise-report-2/report.html")


def test_every_verb_that_writes_is_known_here():
    writing = {
        verb
        for verb, command in verbs().items()
        if any("--out" in param.opts for param in command.params)
    }
    assert writing == set(WRITTEN)


def test_git_ignores_what_verbs_write_and_nothing_else():
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("this is not a checkout, or there is no git")
    names = {name for names in WRITTEN.values() for name in names}
    names |= {f"{Path(name).stem}-2{Path(name).suffix}" for name in names if "/" not in name}
    names |= set(OTHERS)
    command = ["git", "check-ignore", "--no-index", "--stdin"]

    def ignored(names):
        text = "\n".join(sorted(names))
        done = subprocess.run(
            command, cwd=ROOT, input=text, capture_output=True, text=True, check=False
        )
        return set(done.stdout.splitlines())

    assert ignored(names) == names
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert ignored(tracked.stdout.splitlines()) == set()
