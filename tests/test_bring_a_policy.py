"""The page docs/how-to/bring-a-policy.md runs as it is printed."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path

import pytest

from equipoise.cli import main
from equipoise.control.bound_policy import BUILT_IN, load_policy
from equipoise.logs.run_log import RunLog
from equipoise.worlds.certification import Certificate
from equipoise.worlds.evaluation import Evaluation
from tests.reference.onnx_network import FLOAT, linear_network

PAGE = (Path(__file__).parents[1] / "docs" / "how-to" / "bring-a-policy.md").read_text()
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.compiled_only
def test_the_page_runs_as_it_is_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "own_policy", raising=False)
    (tmp_path / "network.onnx").write_bytes(
        linear_network([[1.2], [1.8], [24.0], [3.0]], element=FLOAT)
    )
    commands = []
    for language, text in BLOCK.findall(PAGE):
        if language == "python":
            file = re.match(r"# (\w+\.py)\n", text)
            (tmp_path / file[1]).write_text(text)
        else:
            commands += [shlex.split(line) for line in text.splitlines()]
    assert len(commands) == 7
    for command, *words in commands:
        assert command == "equipoise"
        if "network.onnx" in words and importlib.util.find_spec("onnxruntime") is None:
            continue
        assert main(words) == 0, words
    policy = load_policy("own_policy:balance")
    evaluation = Evaluation.load(tmp_path / "evaluation.json")
    assert (evaluation.policy, evaluation.results.name) == (policy.digest, policy.name)
    assert Certificate.load(tmp_path / "certificate.json").evaluation.policy == policy.digest
    assert RunLog.load(tmp_path / "run.mcap").conditions.policy == policy.digest
    sys.modules.pop("own_policy")


def test_the_page_names_every_built_in_policy():
    assert all(f"`{name}`" in PAGE for name in BUILT_IN)
