"""Checkpoints: an interrupted training goes on, and the same bits come out."""

import json

import numpy as np
import pytest

from equipoise import artefacts
from equipoise.artefacts import PartialFile
from equipoise.errors import ArtefactError
from equipoise.learning import training
from equipoise.learning.checkpoint import ResumePoint, pack, unpack
from equipoise.learning.episodes import new_training_state
from equipoise.learning.training import TargetProgress, train, train_to_target
from equipoise.model.actuator import Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.settings import resolve

# Thousands of steps: minutes without compilation.
pytestmark = pytest.mark.compiled_only

ARM = iiwa(14)
QUICK = [
    "learning.episodes=60",
    "learning.episode_duration=1",
    "selection.every=20",
    "selection.late=1",
    "selection.round_trials=8",
    "selection.duration=4",
    "selection.test_trials=100",
]
SLOW = Actuator.assumed("kst", delay=0.01, lag=0.004, cycle=0.016)
SETTINGS = {
    "robust": resolve("robust", overrides=QUICK),
    "paper": resolve("paper", overrides=[*QUICK, "selection.every=0"]),
    "sarsa": resolve("robust", overrides=[*QUICK, "learning.learner=sarsa"]),
    "watkins": resolve("paper", overrides=[*QUICK, "learning.learner=watkins"]),
    "two actuators": resolve("robust", overrides=QUICK),
}


class Interruption:
    """Raises `KeyboardInterrupt` at the n-th call of any of its callbacks, in each thread."""

    def __init__(self, after):
        self.after = after

    def __call__(self, *_):
        self.after -= 1
        if self.after < 0:
            raise KeyboardInterrupt


class Stopping(TargetProgress):
    """Callbacks of which the n-th call, and all further ones, raise `KeyboardInterrupt`."""

    def __init__(self, after):
        stop = Interruption(after)
        self.report = self.selecting = self.testing = self.finished = stop


@pytest.fixture(scope="module")
def undisturbed(pendulum):
    return train_to_target(pendulum, ARM, SETTINGS["robust"], target=0.9, learners=4, seed=5)


@pytest.mark.parametrize("workers", [1, 2])
def test_learners_that_are_interrupted_again_and_again_give_the_same_bits(
    pendulum, undisturbed, tmp_path, workers
):
    partial, interruptions = tmp_path / "policy.partial.json", 0
    while True:
        try:
            found = train_to_target(
                pendulum,
                ARM,
                SETTINGS["robust"],
                target=0.9,
                learners=4,
                seed=5,
                workers=workers,
                partial=partial,
                progress=Stopping(15 + interruptions % 3),
            )
        except KeyboardInterrupt:
            interruptions += 1
            assert interruptions < 50
            continue
        break
    assert interruptions >= 2
    assert found.policy.digest == undisturbed.policy.digest
    assert found.learners == undisturbed.learners


def test_a_finished_learner_is_neither_trained_nor_tested_again(
    pendulum, undisturbed, tmp_path, monkeypatch
):
    monkeypatch.setattr(artefacts, "WRITE_INTERVAL", 0.0)
    monkeypatch.setattr(artefacts, "MAX_WRITING_SHARE", np.inf)
    partial = tmp_path / "policy.partial.json"
    task = pendulum, ARM, SETTINGS["robust"]
    train_to_target(*task, target=0.9, learners=4, seed=5, partial=partial)
    monkeypatch.setattr(training, "train_episodes", None)
    monkeypatch.setattr(training, "race", None)
    monkeypatch.setattr(training, "measure_share", None)
    again = train_to_target(*task, target=0.9, learners=4, seed=5, partial=partial)
    assert again == undisturbed
    # The file holds figures and one policy, whatever the number of learners.
    state = ResumePoint.load(partial)
    assert (state.learners, len(state.finished)) == ({}, 4)
    assert state.best.learner == undisturbed.policy.learner


@pytest.mark.parametrize("recipe", SETTINGS)
def test_a_training_goes_on_from_any_checkpoint(pendulum, tmp_path, monkeypatch, recipe):
    monkeypatch.setattr(artefacts, "WRITE_INTERVAL", 0.0)
    monkeypatch.setattr(artefacts, "MAX_WRITING_SHARE", np.inf)
    partial, checkpoints = tmp_path / "policy.partial.json", []

    def copy(*_):
        checkpoints.append(partial.read_bytes())

    of_all = {"seed": 5, "partial": partial}
    if recipe == "two actuators":
        of_all["actuator"] = [shipped_actuator(), SLOW]
    settings = SETTINGS[recipe]
    policy = train(pendulum, ARM, settings, **of_all, report=copy, selecting=copy)
    assert len(set(checkpoints)) >= 3
    # Without a selection there is a point for nearly each episode.
    for content in checkpoints[:: max(len(checkpoints) // 4, 1)]:
        partial.write_bytes(content)
        points = []
        again = train(pendulum, ARM, settings, **of_all, report=points.append)
        assert again.digest == policy.digest
        assert points[0] in policy.learning_curve
        assert tuple(points) == policy.learning_curve[-len(points) :]


def test_a_finished_training_runs_no_episode_again(pendulum, tmp_path, monkeypatch):
    partial = tmp_path / "policy.partial.json"
    monkeypatch.setattr(artefacts, "WRITE_INTERVAL", 0.0)
    monkeypatch.setattr(artefacts, "MAX_WRITING_SHARE", np.inf)
    policy = train(pendulum, ARM, SETTINGS["robust"], seed=5, partial=partial)
    monkeypatch.setattr(training, "train_episodes", None)
    again = train(pendulum, ARM, SETTINGS["robust"], seed=5, partial=partial)
    assert again.digest == policy.digest


@pytest.fixture(scope="module")
def checkpoint(pendulum, tmp_path_factory):
    """A training that was interrupted at its second candidate."""
    partial = tmp_path_factory.mktemp("checkpoint") / "policy.partial.json"
    with pytest.raises(KeyboardInterrupt):
        train(pendulum, ARM, SETTINGS["robust"], partial=partial, report=Interruption(1))
    return partial


OTHERS = {
    "seed": {"seed": 1},
    "number of the learner": {"learner": 1},
    "learner and settings": {
        "settings": resolve("robust", overrides=[*QUICK, "learning.learner=sarsa"])
    },
    "reward and settings": {
        "settings": resolve("robust", overrides=[*QUICK, "learning.reward=alive"])
    },
    "settings": {"settings": resolve("robust", overrides=[*QUICK, "learning.gamma=0.96"])},
    "arm": {"arm": iiwa(7)},
    "actuator": {"actuator": [shipped_actuator(), SLOW]},
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_checkpoint_of_another_training_is_refused_by_what_differs(pendulum, checkpoint, name):
    before = checkpoint.read_bytes()
    task = {"pendulum": pendulum, "arm": ARM, "settings": SETTINGS["robust"]} | OTHERS[name]
    with pytest.raises(ArtefactError, match=f"with another {name};"):
        train(**task, partial=checkpoint)
    assert checkpoint.read_bytes() == before


def test_a_checkpoint_of_other_code_is_refused(pendulum, checkpoint, monkeypatch):
    monkeypatch.setattr(training, "kernel_sources_digest", lambda: "other kernels")
    with pytest.raises(ArtefactError, match="another version of Equipoise"):
        train(pendulum, ARM, SETTINGS["robust"], partial=checkpoint)


def test_a_checkpoint_is_small(checkpoint):
    # Two candidates; 48 of them take a megabyte.
    assert checkpoint.stat().st_size < 300_000


def test_a_state_that_no_training_has_is_refused():
    progress = new_training_state(270)
    unpack(pack(progress), progress)
    with pytest.raises(ArtefactError, match="bytes of state"):
        unpack(pack(progress)[:-1], progress)
    for name, value in (("action", 8), ("place", 16), ("box", 270), ("box", -1), ("totals", 17)):
        wrong = new_training_state(270)
        values = wrong.totals if name == "totals" else getattr(wrong.decisions, name)
        values[2] = value
        with pytest.raises(ArtefactError, match="out of range"):
            unpack(pack(wrong), new_training_state(270))


def test_a_file_of_unfinished_work_takes_a_bounded_share_of_the_time(
    checkpoint, tmp_path, monkeypatch
):
    now, written = [0.0], []
    monkeypatch.setattr(artefacts.time, "monotonic", lambda: now[0])
    state = ResumePoint.load(checkpoint)

    def slow():
        written.append(now[0])
        now[0] += 2.0
        return state

    file = PartialFile(tmp_path / "work.partial.json", "test", slow)
    while now[0] < 1000.0:
        file.update()
        now[0] += 0.5
    assert written[0] == artefacts.WRITE_INTERVAL
    assert np.min(np.diff(written)) >= 2.0 + 2.0 / artefacts.MAX_WRITING_SHARE
    assert len(written) > 5
    assert json.loads((tmp_path / "work.partial.json").read_text())["format"] == ResumePoint.FORMAT
