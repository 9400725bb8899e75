"""Tasks in other processes: what travels there, and that bits do not depend on it.

A cluster needs Ray, which is large. The default run therefore pickles functions, tasks and results
as the cluster does, and runs them here; the slow test starts a cluster of two nodes.
"""

import json
import os
import pickle
import subprocess
import sys
from importlib.util import find_spec

import pytest

from equipoise import cluster, errors
from equipoise.cluster import RayExecutor, _call
from equipoise.control.bound_policy import load_policy
from equipoise.errors import EquipoiseError, InputError, MissingExtraError
from equipoise.executors import ThreadExecutor
from equipoise.jit import kernel_sources_digest
from equipoise.learning.target import train_to_target
from equipoise.model.arms.iiwa import iiwa
from equipoise.settings import resolve
from equipoise.studies.compare import compare
from equipoise.studies.gap import gap
from equipoise.worlds import setup_of, simulate
from equipoise.worlds.evaluation import evaluate
from tests.apps.report.made_up_gap import paper_policy, with_cures

pytestmark = pytest.mark.compiled_only
SHORT = (
    *("learning.episodes=40", "learning.episode_duration=2", "selection.every=10"),
    *("selection.round_trials=8", "selection.rounds=2", "selection.duration=1"),
    "selection.test_trials=320",
)


class PickledExecutor:
    """What a cluster does with functions, tasks and results, here; the last task comes first."""

    is_remote = True
    workers = 3

    def __init__(self):
        self.ran = 0

    def completed(self, function, tasks):
        work = kernel_sources_digest(), pickle.dumps(function)
        for i in reversed(range(len(tasks))):
            result, error = pickle.loads(_call(work, pickle.dumps(tasks[i])))
            self.ran += 1
            if error is not None:
                raise error
            yield i, result


@pytest.fixture
def remote():
    executor = PickledExecutor()
    yield executor
    assert executor.ran


def few(policy, trials, duration):
    length = {"trials": trials, "duration": duration}
    evaluation = policy.settings.evaluation.model_copy(update=length)
    return policy.settings.model_copy(update={"evaluation": evaluation})


@pytest.mark.parametrize("world", ["ideal", "model", "twin:nominal"])
def test_an_evaluation_has_the_same_bits(world, remote):
    policy = load_policy("lqr")
    given = {"world": world, "with_baselines": False, "seed": 3}
    settings = few(policy, 40, 1.0)
    here = evaluate(policy, settings, workers=2, **given)
    there = evaluate(policy, settings, workers=remote, **given)
    assert there.results == here.results


@pytest.mark.parametrize("population", [False, True])
def test_learners_have_the_same_bits(population, pendulum, remote):
    task = pendulum, iiwa(7), resolve(overrides=SHORT)
    given = {"target": 0.9, "learners": 4, "population": population, "seed": 2}
    here = train_to_target(*task, workers=2, **given)
    there = train_to_target(*task, workers=remote, **given)
    assert there.policy.digest == here.policy.digest
    assert there.learners == here.learners


def test_an_interrupted_population_keeps_what_other_processes_finished(
    pendulum, remote, tmp_path, monkeypatch
):
    task = pendulum, iiwa(7), resolve(overrides=SHORT)
    given = {"target": 0.9, "learners": 4, "population": True, "seed": 2}
    partial = tmp_path / "partial.json"

    def interrupted(function, tasks, whole=remote.completed):
        for i, result in whole(function, tasks):
            if i == 1:
                raise KeyboardInterrupt
            yield i, result

    monkeypatch.setattr(remote, "completed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train_to_target(*task, workers=remote, partial=partial, **given)
    monkeypatch.undo()
    ran = remote.ran
    there = train_to_target(*task, workers=remote, partial=partial, **given)
    assert remote.ran == ran + 2  # learners 0 and 1
    assert there.policy.digest == train_to_target(*task, **given).policy.digest


def test_a_comparison_has_the_same_bits(remote):
    given = {"rows": ("lqr",), "worlds": ("model",), "trials": 20, "duration": 1.0}
    here, there = (compare(**given, workers=each).comparison for each in (2, remote))
    assert [row.cells for row in there.rows] == [row.cells for row in here.rows]


def test_a_gap_has_the_same_bits(small_policy, remote):
    policy = with_cures(small_policy)
    given = {"paper_policy": paper_policy(policy), "trials": 2, "duration": 0.2, "quick": True}
    here, there = (gap(policy, **given, workers=each) for each in (2, remote))
    assert there.digest == here.digest


def test_an_error_of_a_task_is_the_callers(remote):
    def kinds(kind):
        return {kind}.union(*map(kinds, kind.__subclasses__()))

    for kind in kinds(EquipoiseError):
        error = kind("optuna", "sweep") if kind is MissingExtraError else kind("seven is odd")
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is kind
        assert str(again) == str(error)
    with pytest.raises(InputError, match="seven is odd"):
        list(remote.completed(fail, [7]))


def fail(_):
    raise errors.SettingsError("seven is odd")


def test_a_node_with_other_kernels_refuses():
    _, error = pickle.loads(_call(("other", pickle.dumps(abs)), pickle.dumps(1)))
    assert "another version of Equipoise" in str(error)


def test_a_world_of_one_process_does_not_travel():
    policy = load_policy("lqr")
    simulation = simulate("model", setup_of(policy, "model"), seed=0, stream=0)
    simulation.setup = None
    with pytest.raises(TypeError, match="runs in the process that made it"):
        pickle.dumps(simulation)


def test_processes_that_begin_together_compile_once(tmp_path, monkeypatch):
    """The second process waits for the first one, and then goes on beside the third."""
    program = (
        "import sys, time\n"
        "from equipoise.cluster import _first_of_node\n"
        "begin = time.monotonic()\n"
        "with _first_of_node():\n"
        "    time.sleep(1.0)\n"
        "    print(begin, time.monotonic())\n"
    )
    environment = os.environ | {"EQUIPOISE_CACHE_DIR": str(tmp_path)}
    given = {"env": environment, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([sys.executable, "-c", program], **given) for _ in range(3)]
    ends = sorted(float(process.communicate()[0].split()[1]) for process in processes)
    assert ends[1] - ends[0] > 0.9
    assert ends[2] - ends[1] < 0.5


def test_without_ray_the_message_names_the_extra(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(cluster, "import_module", absent)
    with pytest.raises(MissingExtraError, match="ray"):
        RayExecutor("head:6379")


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("auto", "expected HOST:PORT"),
        ("ray://head:10001", "expected HOST:PORT"),
        ("head:99999", "expected HOST:PORT"),
        ("127.0.0.1:1", "no Ray cluster answers at 127.0.0.1:1"),
    ],
)
def test_an_address_without_a_cluster_is_one_error(address, said, monkeypatch):
    monkeypatch.setattr(cluster, "import_module", lambda _: None)
    with pytest.raises(EquipoiseError, match=said):
        RayExecutor(address)


def test_threads_are_not_remote():
    assert not ThreadExecutor(2).is_remote


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_a_cluster_that_loses_parts_of_itself_gives_the_same_bits(tmp_path):
    command = [sys.executable, "benchmarks/cluster.py", "--trials", "24", "--learners", "6"]
    ended = subprocess.run([*command, "--out", tmp_path / "out"], check=False)
    record = json.loads((tmp_path / "out" / "cluster.json").read_text())
    assert [event["killed"] for event in record["events"]] == ["worker", "driver", "driver"]
    assert record["distinct"] == 24
    assert record["same_bits"]
    assert record["same_policy"]
    assert ended.returncode == 0
