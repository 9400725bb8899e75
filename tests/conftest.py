"""Values that tests of several rooms share."""

import os
import runpy
import signal
import sys
from importlib.util import find_spec
from pathlib import Path

import hypothesis
import pytest

from equipoise import Pendulum, iiwa, train
from equipoise.model.actuator import IDEAL_ACTUATOR
from equipoise.physics_engine import mujoco
from equipoise.reproduction.warm_up import is_warm, warm_up
from equipoise.settings import EvaluationSettings, LearningSettings, SelectionSettings, Settings

mujoco()  # before a test imports MuJoCo, which chooses its OpenGL then

# The first call of a kernel compiles it, which takes seconds: no single example has a deadline.
hypothesis.settings.register_profile("equipoise", deadline=None, max_examples=50)
hypothesis.settings.load_profile("equipoise")


collect_ignore = [] if find_spec("cbor") else ["coppeliasim_server.py"]


def pytest_configure(config):
    """Compile the kernels before several workers start, which would compile the same ones."""
    several = getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput")
    if several and not is_warm():
        warm_up()


def pytest_collectreport(report):
    """Refuse a test file that cannot be imported: with its doctests, pytest skips its tests."""
    reason = str(report.longrepr)
    if report.skipped and "unable to import module" in reason and "/tests/" in reason:
        raise pytest.UsageError(reason)


def tiers(values, quick, full=()):
    """Return parameters of a test: quick ones run always, others with the mark full, or slow."""
    slow = pytest.mark.slow
    marks = {**dict.fromkeys(full, pytest.mark.full), **dict.fromkeys(quick, ())}
    return [pytest.param(value, marks=marks.get(value, slow)) for value in values]


def written(name, content):
    """Write a file, text or bytes, into the folder of the test; return its path."""
    path = Path(name).absolute()
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Run each test in an empty folder: the one of the checkout may hold files of the user."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def _interruptible():
    """Let Ctrl-C interrupt each test and its processes, also where a shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def script(monkeypatch, capsys):
    """Run a file as a script; return what it prints."""

    def run(path, *arguments):
        monkeypatch.setattr(sys, "argv", [path.stem, *map(str, arguments)])
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture(scope="session")
def pendulum():
    """The paper's pendulum: a period of 0.75 s; nobody published its friction."""
    return Pendulum.assumed(70.2, 0.15)


@pytest.fixture(scope="session")
def quick_settings():
    """A training of a second, with a selection, and trials of three seconds."""
    return Settings(
        learning=LearningSettings(episodes=120, episode_duration=2),
        selection=SelectionSettings(every=40, trials=4, duration=2, test_trials=20),
        evaluation=EvaluationSettings(trials=20, duration=2),
    )


@pytest.fixture(scope="session")
def small_policy(pendulum, quick_settings):
    """A policy that has hardly been trained, on the plant of the paper's simulation."""
    return train(pendulum, iiwa(14), quick_settings, actuator=IDEAL_ACTUATOR, seed=7)


@pytest.fixture(scope="session")
def recordings():
    """The folder of the recorded swings."""
    folder = os.environ.get("EQUIPOISE_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("no recordings: set EQUIPOISE_DATA to the folder that holds them")
    return Path(folder)


@pytest.fixture(scope="session")
def rig_log(tmp_path_factory):
    """The log of a whole run on an emulated rig: home, self-test, lift, 1.5 s of balancing."""
    import fcntl  # not on Windows, where no rig runs

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # the workers share one
        folder = folder.parent
    path = folder / "rig.mcap"
    with (folder / "rig.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            from equipoise.rig.run import run_virtually
            from tests.rig.test_run import request

            wanted = request(duration=1.5, robot="kst://twin:nominal")
            assert run_virtually(wanted, path).outcome == "survived"
    return path
