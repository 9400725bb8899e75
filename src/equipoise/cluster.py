"""Execution of tasks on a Ray cluster.

Functions and tasks are pickled by plain pickle: settings travel, and the kernels are compiled where
they run. A task whose process or machine is lost runs again elsewhere; its result is the same,
since a task is a pure function. The nodes need the same versions of Equipoise, Python and Ray, and
the modules of own learners and rewards.
"""

import pickle
import socket
from collections.abc import Callable, Generator, Sequence
from importlib import import_module
from typing import Any, Final, TypeVar

from equipoise.errors import InputError, LinkError, MissingExtraError, OutsideError
from equipoise.jit import kernel_sources_digest
from equipoise.printable import printable

Task = TypeVar("Task")
Result = TypeVar("Result")

RETRIES: Final = 3
"""Number of times that a task runs again after the loss of its process or machine."""
ANSWER_TIME: Final = 5.0
"""Time in which the head of a cluster has to answer [s]; Ray itself tries for minutes."""


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
        try:
            ray: Any = import_module("ray")
        except ImportError:
            raise MissingExtraError("ray", "ray") from None
        host, _, port = address.rpartition(":")
        if not (host and port.isdecimal()):
            raise InputError(
                f"the Ray cluster {printable(address)!r} has no address; expected HOST:PORT of its "
                "head, as ray start --head prints it"
            )
        try:
            socket.create_connection((host.strip("[]"), int(port)), ANSWER_TIME).close()
            ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
        except (OSError, OverflowError) as error:
            raise LinkError(
                f"no Ray cluster answers at {printable(address)} ({error}); start one with "
                "ray start --head, and give the address that it prints"
            ) from None
        except (RuntimeError, ValueError) as error:
            raise InputError(
                f"the Ray cluster at {printable(address)} does not take this program: "
                f"{printable(str(error))[:500]}; install equal versions on all machines"
            ) from None
        self._ray = ray
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 0)))
        """Number of cores of the cluster when it was joined."""

    def completed(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Generator[tuple[int, Result]]:
        """Call a function for each task, and yield the results as they complete.

        See `equipoise.executors.Executor.completed`.

        Raises:
            OutsideError: A task was lost more than `RETRIES` times.
        """
        ray = self._ray
        call: Any = ray.remote(_call).options(num_cpus=1, max_retries=RETRIES)
        work = ray.put((kernel_sources_digest(), pickle.dumps(function)))
        running = {call.remote(work, pickle.dumps(tasks[i])): i for i in range(len(tasks))}
        try:
            while running:
                (ready,), _ = ray.wait(list(running), num_returns=1)
                try:
                    result = pickle.loads(ray.get(ready))
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                except ray.exceptions.RayError as error:
                    raise OutsideError(
                        f"a task was lost {RETRIES + 1} times: {printable(str(error))[:500]}; see "
                        "the log of its node"
                    ) from None
                yield running.pop(ready), result
        finally:
            for each in running:
                ray.cancel(each)


def _call(work: tuple[str, bytes], task: bytes) -> bytes:
    """Return the pickled result of a pickled function for a pickled task."""
    digest, function = work
    if digest != kernel_sources_digest():
        raise InputError(
            "a node of the cluster has another version of Equipoise; install the same on all"
        )
    return pickle.dumps(pickle.loads(function)(pickle.loads(task)))
