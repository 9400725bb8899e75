"""Execution of independent tasks: the one place where work is spread over threads or machines.

Populations of learners and pieces of an evaluation are tasks: a function, and a sequence of its
arguments. A result does not depend on where its task ran. Compiled kernels release the interpreter,
so that threads use all cores. `equipoise.cluster` spreads tasks over machines.
"""

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import NamedTuple, Protocol, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


class Executor(Protocol):
    """Runner of independent tasks."""

    @property
    def workers(self) -> int:
        """Number of tasks that run at the same time."""
        ...

    @property
    def is_remote(self) -> bool:
        """Whether tasks run in other processes.

        Functions and tasks are pickled then, and callbacks of the caller are out of reach.
        """
        ...

    def completed(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Generator[tuple[int, Result]]:
        """Call a function for each task, and yield the results as they complete.

        Args:
            function: Function of one task, called in any thread or process.
            tasks: Arguments.

        Yields:
            Index of the task, and its result. An error of a task is raised here. After it, or once
            the iterator is closed, no further task begins.
        """
        ...


class ThreadExecutor(NamedTuple):
    """Runner of tasks in the threads of this process."""

    workers: int
    """Number of threads; a single one is the caller's."""
    is_remote: bool = False
    """Always false; see `Executor.is_remote`."""

    def completed(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Generator[tuple[int, Result]]:
        """Call a function for each task, and yield the results as they complete.

        See `Executor.completed`.
        """
        if self.workers == 1:
            for i in range(len(tasks)):
                yield i, function(tasks[i])
            return

        def run(i: int) -> Result:
            return function(tasks[i])

        pool = ThreadPoolExecutor(self.workers)
        try:
            index_of = {pool.submit(run, i): i for i in range(len(tasks))}
            for future in as_completed(list(index_of)):
                yield index_of.pop(future), future.result()
        finally:
            pool.shutdown(cancel_futures=True)


Workers = int | Executor
"""Number of threads, or an executor."""


def executor_of(workers: Workers) -> Executor:
    """Return the executor of a number of threads, or the given one."""
    return ThreadExecutor(workers) if isinstance(workers, int) else workers


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
