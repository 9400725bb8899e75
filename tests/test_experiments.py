"""The experiments run in their smallest size, and their methods agree with independent ones."""

import json
import runpy
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import equipoise as eq
from equipoise.model.grid import mirrored_box

pytestmark = pytest.mark.full

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
SHORT = (
    *("--set", "learning.episodes=40", "--set", "learning.episode_duration=1"),
    *("--set", "selection.every=20", "--set", "selection.trials=4"),
    *("--set", "selection.test_trials=300", "--set", "selection.duration=0.5"),
)
"""Short trainings."""
TRIALS = ("--trials", "2", "--duration", "0.3")
ONE_ON_MODEL = ("--world", "model", "--seeds", "1", "--attempts", "1")
SMALLEST = {
    "sweep": (
        *(*SHORT, "--trials", "2", "--tests", "2", "--duration", "0.3"),
        *("--vary", "learning.gamma=0.9:0.99:log", "--vary", "boxes.x=[[-0.1, 0.1]]"),
        *("--storage", "sqlite:///sweep.sqlite3"),
    ),
    "table_search": (*SHORT, "--generations", "1", "--tables", "6", "--out", "best.json"),
    "value_iteration": ("--rounds", "1", "--loops", "8", "--ticks", "50", "--out", "solved.json"),
}
WRITES = {"table_search": "best.json", "value_iteration": "solved.json"}


@pytest.fixture
def experiment(script, monkeypatch):
    """Run an experiment as a script; return what it prints."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return lambda name, *arguments: script(ROOT / f"{name}.py", *arguments)


def module(name):
    """Return the names of an experiment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXPERIMENTS)
        return runpy.run_path(str(EXPERIMENTS / f"{name}.py"))


@pytest.mark.parametrize("name", SMALLEST)
def test_an_experiment_runs_and_writes_its_result(experiment, tmp_path, name):
    assert experiment(f"experiments/{name}", *SMALLEST[name]).strip()
    written = tmp_path / WRITES.get(name, f"{name}.png")
    assert written.stat().st_size > 1000
    if name in WRITES:
        assert eq.TabularPolicy.load(written).settings.boxes.count == 270


def paths(value, *above):
    """The paths of all numbers; of a list of objects those of the first one."""
    if isinstance(value, list) and isinstance(value[0], dict):
        return paths(value[0], *above)
    if isinstance(value, dict):
        return {path for key, each in value.items() for path in paths(each, *above, key)}
    return {above}


@pytest.mark.parametrize(
    ("section", "arguments"),
    [
        pytest.param("compare", (*SHORT, *TRIALS, "--quick", "--known"), marks=pytest.mark.slow),
        ("map", ("lqr", "--starts", "9", "--duration", "0.3")),
        ("gap", (*SHORT, *TRIALS)),
        ("ladder", (*SHORT, *TRIALS, "--seeds", "1")),
        ("literal", (*SHORT, *TRIALS, "--seeds", "2", "--ideal-trials", "2")),
        ("identification", ("--worlds", "pd", "--logs", "1")),
        ("night", ("--hours", "0.001", "--runs", "2", "--duration", "1")),
        ("survival-nominal", (*SHORT, *TRIALS, *ONE_ON_MODEL, "--out", ".")),
    ],
)
def test_a_script_writes_what_the_file_of_results_holds(experiment, section, arguments):
    script = "benchmarks/twin" if section == "survival-nominal" else f"experiments/{section}"
    experiment(script, *arguments, "--json", "values.json")
    written = json.loads(Path("values.json").read_text())
    stored = json.loads((ROOT / "docs" / "results.json").read_text())[section]["values"]
    assert paths(stored) <= paths(written)


# What runs buy


def test_a_fall_lowers_the_value_of_its_last_action_and_every_other_step_moves_towards_the_next():
    on_robot, settings = module("on_robot"), eq.Settings()
    tables = on_robot["new_tables"](270, 0)
    tables.Q[:] = np.linspace(0.0, 1.0, 270)[:, None]
    before = tables.Q.copy()
    ticks = SimpleNamespace(box=np.array([10, 11, 12]), u=np.array([-2.0, 2.0, 2.0]))
    log = SimpleNamespace(ticks=ticks, ending=SimpleNamespace(outcome="angle"))
    on_robot["learn"](tables, [log], settings)
    alpha, gamma = settings.learning.alpha_initial, settings.learning.gamma
    towards = (1 - alpha) * before[10, 0] + alpha * gamma * before[11, 0]
    assert tables.Q[10, 0] == pytest.approx(towards)
    assert tables.Q[12, 7] == pytest.approx((1 - alpha) * before[12, 7] - alpha)
    assert tables.visits.sum() == 6  # the mirror images, too


# Value iteration


def test_the_values_solve_bellmans_equation_and_are_symmetric():
    solved, gamma, boxes = module("value_iteration"), 0.9, 6
    N = np.random.default_rng(0).integers(0, 4, (boxes, 8, boxes + 1))
    N[2, 5] = N[3, 2] = 0  # a pair that never occurred, and its mirror image
    Q, failed = solved["solve"](N, gamma), solved["FAILED"]
    assert pytest.approx(Q[::-1, ::-1]) == Q
    mirrored = [mirrored_box(box, boxes) for box in range(boxes)] + [boxes]
    for s in range(boxes):
        for a in range(8):
            both = N[s, a] + N[mirrored[s], 7 - a, mirrored]
            p = both / max(both.sum(), 1)
            wanted = p[-1] * failed + gamma * sum(p[t] * Q[t].max() for t in range(boxes))
            assert Q[s, a] == pytest.approx(wanted if both.sum() else failed, abs=1e-9)


# Networks


@pytest.mark.slow
@pytest.mark.skipif(
    not (find_spec("stable_baselines3") and find_spec("onnxscript")),
    reason="Stable-Baselines3 or onnxscript is not installed (extra rl)",
)
@pytest.mark.parametrize(("name", "steps"), [("dqn", 600), ("sac", 600), ("ppo", 20_000)])
def test_a_deep_policy_leaves_as_onnx_and_runs_from_it(experiment, tmp_path, name, steps):
    script = ("ppo",) if name == "ppo" else ("rl", "--only", name)
    experiment(f"experiments/{script[0]}", *script[1:], "--steps", steps, "--out", "rl")
    record = json.loads((tmp_path / "rl" / f"{name}.json").read_text())
    assert record["steps"] >= steps
    assert record["different"] <= 5
    policy = eq.load_policy(tmp_path / "rl" / f"{name}.onnx")
    assert abs(policy.policy.act(np.array([0.0, 0.0, 0.15, 1.0]))) <= 2.0
