"""Pages of docs/how-to run as they are printed: files are written, commands are run."""

import re
import shlex
from pathlib import Path

import pytest

from equipoise.cli import main
from equipoise.control.policy import TabularPolicy
from equipoise.studies.sweep_results import read_study

PAGES = Path(__file__).parents[1] / "docs" / "how-to"
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WRITES = {
    "change-the-reward.md": {"alive.json": "alive", "gentle.json": "own_reward:gentle@"},
    "bring-a-learner.md": {"sarsa.json": "sarsa", "own.json": "own_learner:learner@"},
}


@pytest.mark.compiled_only
@pytest.mark.parametrize("name", WRITES)
def test_a_page_runs_as_it_is_printed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    blocks = BLOCK.findall((PAGES / name).read_text())
    assert {language for language, _ in blocks} == {"python", "sh"}
    for language, text in blocks:
        if language == "python":
            file = re.match(r"# (\w+\.py)\n", text)
            (tmp_path / file[1]).write_text(text)
            continue
        for line in text.splitlines():
            command, *words = shlex.split(line)
            assert command == "equipoise"
            assert main(words) == 0
    for file, said in WRITES[name].items():
        learning = TabularPolicy.load(tmp_path / file).settings.learning
        assert said in learning.learner + learning.reward


def test_the_study_of_the_page_on_sweeps_can_be_run(tmp_path):
    (text,) = re.findall(r"^```toml\n(.*?)^```$", (PAGES / "sweep.md").read_text(), re.M | re.S)
    (tmp_path / "study.toml").write_text(text)
    study = read_study(tmp_path / "study.toml")
    assert study.count == 40
    drawn = {name: found.low for name, found in study.ranges.items() if found.choices is None}
    study.resolved(drawn | {"plant.lag_spread": 0.3, "boxes.x": [-0.14, -0.07, 0.07, 0.14]})
