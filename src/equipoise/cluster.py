"""Execution of tasks on a cluster, by Ray.

Functions and tasks are pickled by plain pickle: settings travel, and the kernels are compiled where
they run. A node compiles each kernel once, into the cache of its user: of the processes that begin
on it together, one goes ahead. A task whose process or machine is lost runs again elsewhere; its
result is the same, since a task is a pure function.

The nodes need the same versions of Equipoise, Python and Ray, and the modules of own learners and
rewards.
"""

import logging
import os
import pickle
import socket
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Final, TypeVar

from equipoise.errors import EquipoiseError, InputError, LinkError, MissingExtraError, OutsideError
from equipoise.jit import cache_folder, kernel_sources_digest
from equipoise.printable import printable

Task = TypeVar("Task")
Result = TypeVar("Result")

AHEAD: Final = 2
"""Number of submitted tasks for each core of the cluster: one runs, and one waits at hand."""
RETRIES: Final = 3
"""Number of times that a task runs again after the loss of its process or machine."""

PATIENCE: Final = 5.0
"""Time in which the head of a cluster has to answer [s]."""

_begun = False
"""Whether this process has finished a task: its kernels are in the cache of the node."""


class RayExecutor:
    """Runner of tasks on a Ray cluster; see `equipoise.executors.Executor`."""

    is_remote = True

    def __init__(self, address: str) -> None:
        """Join a running cluster.

        Args:
            address: `HOST:PORT` of the head node.

        Raises:
            InputError: The address is invalid, or its cluster has another version of Python or Ray.
            LinkError: Nothing answers at the address.
            MissingExtraError: Ray is not installed.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        try:
            ray: Any = import_module("ray")
        except ImportError:
            raise MissingExtraError("ray", "ray") from None
        self._ray = ray
        _check_address(address)
        try:
            ray.init(
                address=address,
                ignore_reinit_error=True,
                log_to_driver=False,
                logging_level=logging.CRITICAL,
            )
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            raise InputError(
                f"the Ray cluster at {printable(address)} does not take this program: "
                f"{printable(str(error))[:500]}; install equal versions on all machines"
            ) from None
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 0)))
        """Number of cores of the cluster when it was joined."""
        call: Any = ray.remote(_call)
        self._call = call.options(num_cpus=1, max_retries=RETRIES)

    def completed(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Generator[tuple[int, Result]]:
        """Call a function for each task, and yield the results as they complete.

        See `equipoise.executors.Executor.completed`.

        Raises:
            OutsideError: A task was lost more than `RETRIES` times.
        """
        ray = self._ray
        work = ray.put((kernel_sources_digest(), pickle.dumps(function)))
        waiting, running = iter(range(len(tasks))), dict[Any, int]()
        try:
            while True:
                while len(running) < AHEAD * self.workers:
                    if (i := next(waiting, None)) is None:
                        break
                    running[self._call.remote(work, pickle.dumps(tasks[i]))] = i
                if not running:
                    return
                (ready,), _ = ray.wait(list(running), num_returns=1)
                i = running.pop(ready)
                yield i, self._result(ready, i)
        finally:
            for each in running:
                ray.cancel(each)

    def _result(self, ready: Any, i: int) -> Any:
        exceptions = self._ray.exceptions
        try:
            result, error = pickle.loads(self._ray.get(ready))
        except exceptions.RayTaskError:
            raise  # a fault of the program, with its traceback
        except exceptions.RayError as lost:
            raise OutsideError(
                f"task {i} has no answer from the cluster, after {RETRIES} further attempts where "
                f"its process was lost: {printable(str(lost))[:500]}; see the log of its node"
            ) from None
        if error is not None:
            raise error
        return result


def _check_address(address: str) -> None:
    """Check that something answers at an address: Ray itself tries for minutes."""
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdecimal() and 0 < int(port) < 2**16) or "/" in host:
        raise InputError(
            f"the Ray cluster {printable(address)!r} has no address; expected HOST:PORT of its "
            "head, as ray start --head prints it"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE).close()
    except OSError as error:
        raise LinkError(
            f"no Ray cluster answers at {printable(address)} ({error.strerror or error}); start "
            "one with ray start --head, and give the address that it prints"
        ) from None


def _call(work: tuple[str, bytes], task: bytes) -> bytes:
    """Call a pickled function for a pickled task; return the pickled result and error."""
    digest, function = work
    try:
        if digest != kernel_sources_digest():
            raise InputError(
                "a node of the cluster has another version of Equipoise; install the same on all"
            )
        with _first_of_node():
            return pickle.dumps((pickle.loads(function)(pickle.loads(task)), None))
    except EquipoiseError as error:
        return pickle.dumps((None, error))


@contextmanager
def _first_of_node() -> Generator[None]:
    """Let one of the processes that begin together on a node compile alone.

    The lock ends with its process, also with a killed one. Processes that waited go on together:
    the kernels are in the cache then. On Windows, each process compiles for itself.
    """
    global _begun
    folder = None if _begun or os.name == "nt" else cache_folder("cluster")
    if folder is None:
        yield
        return
    import fcntl

    with (folder / "first.lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(file, fcntl.LOCK_SH)
            fcntl.flock(file, fcntl.LOCK_UN)
        yield
    _begun = True
