"""Executors: workers beside the threads of this process, up to a cluster as a user starts it."""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

import equipoise as eq
from equipoise.errors import InputError, OutsideError, SettingsError
from equipoise.executors import completed, open_workers
from equipoise.settings import changed
from tests.program import start_program, wait_until

FULL = pytest.mark.full
SHORT = {"evaluation.trials": 70, "evaluation.duration": 3.0}
SLOW = ("evaluate", "--trials=100000", "--no-baselines", "--json")
"""A command of minutes."""


def test_a_task_runs_in_any_executor_and_none_is_left_after_an_error():
    begun = []

    def task(number):
        begun.append(number)
        if number == 1:
            raise ValueError(number)
        time.sleep(0.05)
        return number

    with ThreadPoolExecutor(1) as executor:
        assert sorted(completed(task, [5, 7], executor)) == [(0, 5), (1, 7)]
        with pytest.raises(ValueError, match="1"):
            list(completed(task, range(100), executor))
        assert executor.submit(int).result() == 0  # the executor is its owner's
    assert max(begun) < 10


def test_results_do_not_depend_on_the_executor(quick_settings, pendulum):
    policy = eq.shipped_policy()
    args = {"settings": changed(policy.settings, SHORT), "world": "model", "seed": 3}
    with ThreadPoolExecutor(2) as executor:
        assert eq.evaluate(policy, **args, workers=executor) == eq.evaluate(policy, **args)
        trained = eq.train(pendulum, settings=quick_settings, workers=executor)
        assert trained == eq.train(pendulum, settings=quick_settings)


def test_a_policy_in_python_is_refused():
    with ThreadPoolExecutor(1) as executor, pytest.raises(InputError, match="only compiled"):
        eq.evaluate(lambda observation: 24.0 * observation[2], workers=executor)


@pytest.mark.parametrize("named", ["0", "-1", "two", "tcp://", "http://host:1", "tcp://host"])
def test_a_wrong_name_of_workers_is_refused(named):
    with pytest.raises(InputError, match="expected a number of threads"), open_workers(named):
        pass


@FULL
@pytest.mark.parametrize(
    ("scheme", "sends", "message"),
    [
        ("tcp", None, "no Dask scheduler answers at 'tcp://127.0.0.1:"),
        ("tcp", b"", "nothing came within 0.5 s; start it with: dask scheduler$"),
        ("tcp", b"SSH-2.0-OpenSSH_9.2\r\n", "no Dask scheduler answers"),
        ("tls", b"", "check the certificates in Dask's configuration$"),
    ],
    ids=["closed", "silent", "other protocol", "no certificates"],
)
def test_another_server_is_an_error(monkeypatch, scheme, sends, message):
    monkeypatch.setattr("equipoise.executors.CONNECT_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            with contextlib.suppress(OSError), server.accept()[0] as link:
                link.sendall(sends)
                while link.recv(4096):
                    pass

        named = f"{scheme}://127.0.0.1:{server.getsockname()[1]}"
        if sends is None:
            server.close()
        else:
            threading.Thread(target=serve, daemon=True).start()
        with pytest.raises(OutsideError, match=message), open_workers(named):
            pass


class Cluster:
    """A scheduler and its workers, as a user starts them."""

    def __init__(self, stack, folder):
        self.stack, self.folder = stack, folder
        self.file = folder / "scheduler.json"

    def start(self, *words, path=""):
        """Start a part; its packages are found in `path` first."""
        paths = os.pathsep.join(filter(None, [str(path), os.environ.get("PYTHONPATH", "")]))
        command = [sys.executable, "-m", "dask", *words, "--scheduler-file", str(self.file)]
        where = {"env": os.environ | {"PYTHONPATH": paths}, "cwd": self.folder}
        with (self.folder / f"{words[0]}.log").open("a") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, **where)
        self.stack.callback(end, process)
        return process

    def scheduler(self, path=""):
        words = ("--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0")
        process = self.start("scheduler", *words, path=path)
        wait_until(lambda: self.file.exists() and self.file.read_text(), "scheduler")
        self.address = json.loads(self.file.read_text())["address"]
        from distributed import Client

        self.client = self.stack.enter_context(Client(self.address, set_as_default=False))
        return process

    def worker(self, path=""):
        known = len(self.client.scheduler_info(n_workers=-1)["workers"])
        process = self.start("worker", "--nthreads", "1", "--no-dashboard", path=path)
        self.client.wait_for_workers(known + 1, timeout=60)
        return process

    def tasks(self):
        """The tasks that the scheduler has, and those that its workers run."""
        known = self.client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks))
        return known, sum(map(len, self.client.processing().values()))


def end(process):
    with contextlib.suppress(psutil.NoSuchProcess):
        for one in [*psutil.Process(process.pid).children(recursive=True), process]:
            one.kill()
    process.wait()


@pytest.fixture
def cluster(tmp_path):
    with contextlib.ExitStack() as stack:
        yield Cluster(stack, tmp_path)


@pytest.fixture
def two_workers(cluster):
    cluster.scheduler_process = cluster.scheduler()
    cluster.workers = [cluster.worker(), cluster.worker()]
    return cluster


@FULL
@pytest.mark.parametrize("world", ["ideal", "model", "twin:nominal"])
def test_a_cluster_gives_the_bits_of_one_machine(two_workers, world):
    policy, finished = eq.shipped_policy(), []
    args = {"settings": changed(policy.settings, SHORT), "world": world, "seed": 3}
    from_hanging = changed(args["settings"], {"evaluation.start": "hanging"})
    hanging = args | {"settings": from_hanging, "with_baselines": False}
    with open_workers(two_workers.address) as workers:
        found = eq.evaluate(policy, **args, workers=workers, done=finished.append)
        assert found == eq.evaluate(policy, **args, workers=2)
        assert eq.evaluate(policy, **hanging, workers=workers) == eq.evaluate(policy, **hanging)
    assert sum(finished) == 5 * 70


@FULL
def test_eight_seeds_train_alike_on_a_cluster(two_workers, quick_settings, pendulum):
    def train(seed):
        return eq.train(pendulum, settings=quick_settings, seed=seed)

    target = {"settings": quick_settings, "target": 0.5, "attempts": 1}
    with open_workers(two_workers.address) as workers:
        found = dict(completed(train, range(8), workers))
        selected = eq.train_to_target(pendulum, **target, workers=workers)
    assert found == dict(completed(train, range(8), 2))
    assert selected == eq.train_to_target(pendulum, **target)


@FULL
def test_a_killed_worker_costs_time_alone(two_workers):
    policy = eq.shipped_policy()
    settings = changed(policy.settings, {"evaluation.trials": 1000})
    ended = []

    def kill(_):
        if not ended:
            ((worker, number), _) = two_workers.client.run(os.getpid).items()
            ended.append(bool(two_workers.client.processing()[worker]))
            os.kill(number, signal.SIGKILL)

    args = {"settings": settings, "with_baselines": False}
    with open_workers(two_workers.address) as workers:
        found = eq.evaluate(policy, **args, workers=workers, done=kill)
    assert ended == [True]
    assert found == eq.evaluate(policy, **args, workers=2)


@contextlib.contextmanager
def slow_command(cluster):
    """A command of minutes on a cluster, whose tasks run."""
    words = (*SLOW, "--workers", cluster.address)
    command = start_program(sys.executable, "-m", "equipoise", *words)
    try:
        wait_until(lambda: all(cluster.tasks()), "task")
        yield command
    finally:
        command.kill()


@FULL
@pytest.mark.parametrize("delay", [0.1, 1.0], ids=["while it submits", "while it waits"])
def test_a_lost_scheduler_ends_the_command_with_one_error(two_workers, delay):
    with slow_command(two_workers) as command:
        time.sleep(delay)
        two_workers.scheduler_process.kill()
        out, error = command.communicate(timeout=10.0)
    assert (command.returncode, out) == (3, "")
    lost = f"error: the scheduler at {two_workers.address} is lost"
    assert error == f"{lost}; start it again, and repeat the command\n"


@FULL
def test_ctrl_c_leaves_no_task(two_workers):
    with slow_command(two_workers) as command:
        time.sleep(1.0)
        command.send_signal(signal.SIGINT)
        _, error = command.communicate(timeout=10.0)
    assert (command.returncode, error) == (130, "interrupted\n")
    wait_until(lambda: two_workers.tasks() == (0, 0), "end of the tasks", 10.0)


def evaluate_on(cluster):
    settings = changed(eq.shipped_policy().settings, SHORT)
    with open_workers(cluster.address) as workers:
        eq.evaluate(settings=settings, world="model", workers=workers)


@FULL
def test_a_cluster_without_workers_is_an_error(cluster):
    cluster.scheduler()
    with pytest.raises(OutsideError, match="has no workers yet; start one with: dask worker tcp:"):
        evaluate_on(cluster)


@FULL
def test_the_address_of_a_worker_is_an_error(cluster):
    cluster.scheduler()
    cluster.worker()
    (cluster.address,) = cluster.client.scheduler_info(n_workers=-1)["workers"]
    with pytest.raises(OutsideError, match="no Dask scheduler answers at .*: a Worker does"):
        evaluate_on(cluster)


@FULL
def test_a_worker_with_other_kernels_is_an_error(cluster, tmp_path):
    shutil.copytree(Path(eq.__file__).parent, tmp_path / "other" / "equipoise")
    with (tmp_path / "other" / "equipoise" / "paper.py").open("a") as file:
        file.write("# another version\n")
    cluster.scheduler()
    cluster.worker(tmp_path / "other")
    difference = r"worker tcp://\S+ has equipoise .* expected .* install"
    with pytest.raises(OutsideError, match=difference):
        evaluate_on(cluster)


@FULL
@pytest.mark.parametrize("which", ["scheduler", "worker"])
def test_a_scheduler_or_worker_without_the_package_is_an_error(cluster, tmp_path, which):
    (tmp_path / "none").mkdir()
    missing = "raise ModuleNotFoundError(\"No module named 'equipoise'\", name='equipoise')"
    (tmp_path / "none" / "equipoise.py").write_text(missing)
    cluster.scheduler(tmp_path / "none" if which == "scheduler" else "")
    cluster.worker(tmp_path / "none" if which == "worker" else "")
    with pytest.raises(OutsideError, match=f"{which} .* lacks a package: .*'equipoise'.*; install"):
        evaluate_on(cluster)


@FULL
def test_an_error_of_a_task_is_raised_here(two_workers):
    with (
        open_workers(two_workers.address) as workers,
        pytest.raises(InputError, match="nope") as error,
    ):
        list(completed(eq.resolve, ["nope"], workers))
    assert type(error.value) is SettingsError
