"""Execution of independent tasks, in threads and in other processes.

A cluster needs Ray, which is large. The default run therefore pickles functions, tasks and results
as the cluster does, and runs them here; the slow test starts a cluster of two nodes.
"""

import pickle
import threading
import time

import pytest

from equipoise import cluster
from equipoise.cluster import RayExecutor, _call
from equipoise.control.bound_policy import load_policy
from equipoise.errors import EquipoiseError, InputError, MissingExtraError, SettingsError
from equipoise.executors import ThreadExecutor, available_cores
from equipoise.jit import kernel_sources_digest
from equipoise.learning.target import train_to_target
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import shipped_pendulum
from equipoise.settings import resolve
from equipoise.worlds.evaluation import evaluate

WORKERS = pytest.mark.parametrize("workers", [1, 3])
SHORT = (
    *("learning.episodes=40", "learning.episode_duration=2", "selection.every=10"),
    *("selection.round_trials=8", "selection.rounds=2", "selection.duration=1"),
    "selection.test_trials=320",
)


@WORKERS
@pytest.mark.parametrize("count", [0, 100])
def test_every_task_runs_once(workers, count):
    ran = []

    def square(task):
        ran.append(task)
        return task**2

    found = dict(ThreadExecutor(workers).completed(square, range(10, 10 + count)))
    assert found == {i: (10 + i) ** 2 for i in range(count)}
    assert sorted(ran) == list(range(10, 10 + count))


@WORKERS
def test_an_error_or_closing_ends_the_work(workers):
    begun = []

    def work(task):
        begun.append(task)
        time.sleep(0.01)
        if task == 2:
            raise ValueError(task)

    with pytest.raises(ValueError, match="2"):
        list(ThreadExecutor(workers).completed(work, range(1000)))
    assert len(begun) < 100
    results = ThreadExecutor(workers).completed(work, range(3, 1000))
    next(results)
    results.close()
    assert len(begun) < 200


def test_results_come_as_they_complete():
    first_may_end = threading.Event()

    def wait(task):
        if task == 0:
            assert first_may_end.wait(60.0)
        return task

    results = ThreadExecutor(2).completed(wait, range(3))
    assert [next(results), next(results)] == [(1, 1), (2, 2)]
    first_may_end.set()
    assert list(results) == [(0, 0)]


def test_there_is_a_core():
    assert available_cores() >= 1


class PickledExecutor:
    """Pickles as a cluster does, and runs here; the last task comes first."""

    is_remote = True
    workers = 3
    ran = 0

    def completed(self, function, tasks):
        work = kernel_sources_digest(), pickle.dumps(function)
        for i in reversed(range(len(tasks))):
            self.ran += 1
            yield i, pickle.loads(_call(work, pickle.dumps(tasks[i])))


def evaluated(world, workers):
    policy = load_policy("lqr")
    length = {"trials": 40, "duration": 1.0}
    evaluation = policy.settings.evaluation.model_copy(update=length)
    settings = policy.settings.model_copy(update={"evaluation": evaluation})
    given = {"world": world, "with_baselines": False, "seed": 3, "workers": workers}
    return evaluate(policy, settings, **given).results


def trained(target, workers):
    given = {"target": target, "learners": 4, "seed": 2}
    task = shipped_pendulum(), iiwa(7), resolve(overrides=SHORT)
    found = train_to_target(*task, workers=workers, **given)
    return found.policy.digest, found.learners


@pytest.mark.compiled_only
@pytest.mark.parametrize(
    ("work", "of"),
    [
        *((evaluated, world) for world in ("ideal", "model", "twin:nominal")),
        (trained, 0.9),
    ],
)
def test_other_processes_give_the_same_bits(work, of):
    remote = PickledExecutor()
    assert work(of, remote) == work(of, 2)
    assert remote.ran


def test_an_error_of_a_task_travels_whole():
    def kinds(kind):
        return {kind}.union(*map(kinds, kind.__subclasses__()))

    for kind in kinds(EquipoiseError):
        error = kind("optuna", "sweep") if kind is MissingExtraError else kind("seven is odd")
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again)) == (kind, str(error))


def test_a_node_with_other_kernels_refuses():
    with pytest.raises(InputError):
        _call(("other", pickle.dumps(abs)), pickle.dumps(1))


def test_without_ray_the_message_names_the_extra(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(cluster, "import_module", absent)
    with pytest.raises(MissingExtraError, match="ray"):
        RayExecutor("head:6379")


@pytest.mark.parametrize("address", ["auto", "ray://head", "head:99999999", "127.0.0.1:1"])
def test_an_address_without_a_cluster_is_one_error(address, monkeypatch):
    monkeypatch.setattr(cluster, "import_module", lambda _: None)
    with pytest.raises(EquipoiseError):
        RayExecutor(address)


@pytest.mark.slow
@pytest.mark.compiled_only
def test_a_cluster_of_two_nodes_gives_the_same_bits():
    utils = pytest.importorskip("ray.cluster_utils", reason="Ray is not installed (extra ray)")
    head = {"num_cpus": 1, "include_dashboard": False}
    nodes = utils.Cluster(initialize_head=True, head_node_args=head)
    nodes.add_node(num_cpus=1)
    try:
        executor = RayExecutor(nodes.address)
        assert executor.workers == 2
        assert trained(0.9, executor) == trained(0.9, 2)
        with pytest.raises(SettingsError):  # there is no such recipe
            list(executor.completed(resolve, ["seven"]))
    finally:
        utils.ray.shutdown()
        nodes.shutdown()
