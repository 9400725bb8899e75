"""Deep policies of Stable-Baselines3: trained, written as ONNX, compared; needs the extra rl."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from equipoise.control.bound_policy import load_policy
from equipoise.studies.compare import compare

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "rl.py"


@pytest.mark.slow
@pytest.mark.compiled_only
@pytest.mark.parametrize("algorithm", ["dqn", "ppo", "sac"])
def test_a_deep_policy_leaves_as_onnx_and_runs_from_it(algorithm, tmp_path):
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("onnxscript")
    command = [sys.executable, str(SCRIPT), "--only", algorithm, "--steps", "600", "--out", "rl"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "rl" / f"{algorithm}.json").read_text())
    assert record["steps"] >= 600
    assert record["different"] <= 5
    path = tmp_path / "rl" / f"{algorithm}.onnx"
    policy = load_policy(path)
    assert abs(policy.policy.act([0.0, 0.0, 0.15, 1.0])) <= 2.0
    given = {"rows": (), "worlds": ("model",), "trials": 2, "duration": 0.3}
    (row,) = compare([path], **given).comparison.rows
    assert (row.name, row.size) == (path.name, path.stat().st_size)
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert "exists; give another --out" in again.stderr
