"""Sweeps: proposals, storage, resuming, and messages about study files."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pytest

from equipoise.errors import ArtefactError, InputError, SettingsError
from equipoise.executors import ThreadExecutor
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum
from equipoise.settings import parse_toml
from equipoise.studies import sweep as study
from equipoise.studies.sweep_results import Sweep, SweepStudy, SweepTrial, read_study

ARM = iiwa(7)
PENDULUM = Pendulum.assumed(70.2, 0.15)
STUDY = """
trials = 14
seed = 3
batch = 4
objective = "duration"
[settings]
learning.episodes = 30
selection.every = 0
[parameters]
learning.gamma = { low = 0.9, high = 0.999 }
learning.alpha_minimum = { low = 0.001, high = 0.1, log = true }
boxes.x = { choices = [[-0.07, 0.07], [-0.1, 0.1]] }
selection.candidates = { low = 4, high = 16, step = 4 }
"""
PROGRAM = """
import sys, time
from pathlib import Path
from equipoise.executors import ThreadExecutor
from tests.studies import test_sweep as test

def slow(task):
    with open("ran.txt", "a") as file:
        file.write(f"{task.index}\\n")
    time.sleep(0.02)
    return test.quick(task)

test.study.run_trial = slow
found = test.run(Path("sweep.sqlite3"), ThreadExecutor(3), sys.argv[1])
found.save("sweep.json", command="test")
"""


def quick(task):
    """A trial without a training: a smooth function of its parameters, with invalid settings."""
    gamma, alpha = (task.parameters[f"learning.{name}"] for name in ("gamma", "alpha_minimum"))
    given = {"index": task.index, "parameters": task.parameters}
    if alpha > 0.05:
        return SweepTrial(**given, error="too fast")
    duration = 10.0 - 1e4 * (gamma - 0.95) ** 2 / 25.0 - 100.0 * abs(alpha - 0.01)
    return SweepTrial(**given, tests=10, survived=5, duration=max(duration, 0.0))


def read(text):
    return SweepStudy.model_validate(parse_toml(text))


def run(storage, executor=None, text=STUDY):
    return study.sweep(read(text), PENDULUM, ARM, storage=storage, executor=executor)


def stored_indices(storage):
    """Return the sorted indices of the stored trials, as Optuna reads them."""
    stored = optuna.load_study(study_name=study.STUDY_NAME, storage=f"sqlite:///{storage}")
    return sorted(trial.user_attrs["equipoise"]["index"] for trial in stored.trials)


@pytest.fixture
def quick_trials(monkeypatch):
    monkeypatch.setattr(study, "run_trial", quick)


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_equal_studies_give_equal_trials_for_any_number_of_workers(quick_trials, tmp_path, sampler):
    text = f'sampler = "{sampler}"\n{STUDY}'
    found = [run(tmp_path / f"{n}.sqlite3", ThreadExecutor(n), text) for n in (1, 3)]
    assert found[0].digest == found[1].digest
    trials = found[0].trials
    assert [trial.index for trial in trials] == list(range(14))
    assert len({trial.parameters["learning.gamma"] for trial in trials}) == 14
    assert {tuple(trial.parameters["boxes.x"]) for trial in trials} == {(-0.07, 0.07), (-0.1, 0.1)}
    assert {trial.parameters["selection.candidates"] for trial in trials} <= {4, 8, 12, 16}
    other = run(tmp_path / "other.sqlite3", None, text.replace("seed = 3", "seed = 4"))
    assert other.trials[0].parameters != trials[0].parameters


def test_the_best_trial_is_first_and_invalid_ones_are_left_out(quick_trials, tmp_path):
    found = run(tmp_path / "sweep.sqlite3", text=STUDY.replace("14", "30"))
    durations = [trial.duration for trial in found.ranking]
    assert durations == sorted(durations, reverse=True)
    invalid = [trial for trial in found.trials if trial.error]
    assert invalid
    assert len(found.ranking) + len(invalid) == 30


def test_a_path_is_no_address(quick_trials, tmp_path):
    storage = tmp_path / "50 % {of} what?#all.sqlite3"
    assert run(storage).trials == run(storage).trials
    assert [path.name for path in tmp_path.iterdir()] == [storage.name]


def test_more_trials_continue_a_sweep(quick_trials, tmp_path, monkeypatch):
    storage, ran = tmp_path / "sweep.sqlite3", []
    first = run(storage)
    monkeypatch.setattr(study, "run_trial", lambda task: ran.append(task.index) or quick(task))
    more = run(storage, text=STUDY.replace("14", "20"))
    assert ran == list(range(14, 20))
    assert more.trials[:14] == first.trials
    assert more.trials == run(tmp_path / "whole.sqlite3", text=STUDY.replace("14", "20")).trials


@pytest.mark.slow
def test_a_sweep_that_was_killed_twice_resumes_and_runs_no_finished_trial_again(
    quick_trials, tmp_path
):
    text = STUDY.replace("14", "60")
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    ran, storage = tmp_path / "ran.txt", tmp_path / "sweep.sqlite3"
    kept = []

    def begin():
        environment = {**os.environ, "PYTHONPATH": paths}
        command = [sys.executable, "-c", PROGRAM, text]
        return subprocess.Popen(command, cwd=tmp_path, env=environment)

    for begun in (10, 35):
        process = begin()
        while not ran.exists() or len(ran.read_text().split()) < begun:
            assert process.poll() is None
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        kept = [*kept, (len(ran.read_text().split()), set(stored_indices(storage)))]
    assert begin().wait() == 0
    order = list(map(int, ran.read_text().split()))
    assert set(order) == set(range(60))
    for before, finished in kept:
        assert finished
        assert not finished & set(order[before:])
    found = Sweep.load(tmp_path / "sweep.json")
    assert found.digest == run(tmp_path / "undisturbed.sqlite3", text=text).digest
    assert found.digest == run(storage, text=text).digest
    assert stored_indices(storage) == list(range(60))


def test_a_grid_runs_all_combinations(quick_trials, tmp_path):
    text = """
        sampler = "grid"
        [parameters]
        learning.gamma = { low = 0.9, high = 0.96, step = 0.02 }
        learning.alpha_minimum = { choices = [0.01, 0.02, 0.03] }
        """
    found = run(tmp_path / "sweep.sqlite3", text=text)
    points = [tuple(trial.parameters.values()) for trial in found.trials]
    assert len(set(points)) == len(points) == 12
    assert {round(gamma, 9) for _, gamma in points} == {0.9, 0.92, 0.94, 0.96}


def test_another_study_does_not_continue_a_sweep(quick_trials, tmp_path):
    run(tmp_path / "sweep.sqlite3")
    with pytest.raises(ArtefactError, match="holds a sweep with another study"):
        run(tmp_path / "sweep.sqlite3", text=STUDY.replace("0.999", "0.99"))


def test_a_file_that_is_no_storage_is_refused(quick_trials, tmp_path):
    storage = tmp_path / "sweep.sqlite3"
    storage.write_text("no database" * 100)
    with pytest.raises(ArtefactError, match="not the storage of a sweep"):
        run(storage)
    assert storage.read_text() == "no database" * 100


def test_a_sweep_without_a_valid_trial_is_an_error(monkeypatch, tmp_path):
    def fail(task):
        return SweepTrial(index=task.index, parameters=task.parameters, error="no table")

    monkeypatch.setattr(study, "run_trial", fail)
    with pytest.raises(InputError, match="none of 14 trials has valid settings.*no table"):
        run(tmp_path / "sweep.sqlite3")


def test_trials_train_and_test_with_their_settings(tmp_path):
    text = """
        sampler = "grid"
        tests = 8
        duration = 20.0
        objective = "duration"
        [settings]
        selection.every = 0
        [parameters]
        learning.episodes = { choices = [1, 500] }
        plant.lag_spread = { choices = [0.0, 0.2] }
        """
    found = run(tmp_path / "one.sqlite3", ThreadExecutor(1), text)
    assert found.digest == run(tmp_path / "two.sqlite3", ThreadExecutor(2), text).digest
    lasted = {trial.parameters["learning.episodes"]: trial.duration for trial in found.trials}
    assert lasted[1] < lasted[500]
    assert all(trial.tests == 8 and not trial.error for trial in found.trials)
    assert json.loads(found.model_dump_json())["study"]["tests"] == 8


def test_the_study_of_the_how_to_page_is_valid(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "sweep.md").read_text()
    path = tmp_path / "study.toml"
    path.write_text(page.split("```toml\n")[1].split("```")[0])
    assert read_study(path).count == 40


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("trials = 14", "", "trials is missing"),
        ("trials = 14", "trials = 0", "trials"),
        ("batch = 4", "bathc = 4", "bathc"),
        ("batch = 4", 'world = "mars"', "mars"),
        ("low = 0.9,", "", "expected choices, or low and high"),
        ("low = 0.9,", "low = 2.0,", "low must be below high"),
        ("high = 0.999", "high = 1.5", "learning.gamma"),
        ("low = 0.001", "low = 0.0", "low must be positive with log"),
        ("learning.gamma =", "learning.gama =", "did you mean 'gamma'"),
        ("learning.gamma =", "learning.episodes =", "give it once"),
        ("learning.gamma =", "evaluation.duration =", "does not affect a training"),
        ("[[-0.07, 0.07]", "[[-0.07, 0.08]", "symmetric"),
        ("choices = [[-0.07", "low = 1, choices = [[-0.07", "choices go without low"),
        ("batch = 4", 'sampler = "grid"', "a grid needs a step or choices for learning"),
    ],
)
def test_a_bad_study_file_is_refused_before_a_trial_runs(tmp_path, old, new, message):
    path = tmp_path / "study.toml"
    assert STUDY.count(old) == 1
    path.write_text(STUDY.replace(old, new))
    with pytest.raises(SettingsError, match=message) as raised:
        read_study(path)
    assert "study.toml" in str(raised.value)
