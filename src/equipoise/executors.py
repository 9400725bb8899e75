"""Execution of independent tasks: the one place where work is spread over threads or machines.

Populations of learners, pieces of an evaluation, conditions of a gap and trials of a sweep are
tasks: a function, and a sequence of its arguments. A result does not depend on where its task ran.
Compiled kernels release the interpreter, so that threads use all cores. `equipoise.cluster` spreads
tasks over machines: there, function and tasks are pickled, and results come back the same way.
"""

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
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
            tasks: Arguments; a free thread takes the next one.

        Yields:
            Index of the task, and its result. The first error ends all tasks; so does closing the
            iterator.
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
        waiting = list(range(len(tasks)))
        taking = iter(waiting)  # threads share the iterator of a list
        if self.workers == 1:
            for i in taking:
                yield i, function(tasks[i])
            return
        results: SimpleQueue[tuple[int, Result] | None] = SimpleQueue()

        def work_on() -> None:
            try:
                for i in taking:
                    results.put((i, function(tasks[i])))
            except BaseException:
                waiting.clear()
                raise
            finally:
                results.put(None)

        with ThreadPoolExecutor(self.workers) as pool:
            threads = [pool.submit(work_on) for _ in range(self.workers)]
            try:
                for _ in threads:
                    while (completed := results.get()) is not None:
                        yield completed
                for thread in threads:
                    thread.result()
            finally:
                waiting.clear()


Workers = int | Executor
"""Number of threads, or an executor."""


def executor_of(workers: Workers) -> Executor:
    """Return the executor of a number of threads, or the given one."""
    return ThreadExecutor(workers) if isinstance(workers, int) else workers


def run_all(executor: Executor, function: Callable[[Task], object], tasks: Sequence[Task]) -> None:
    """Call `function(task)` for each task; the first error ends all of them.

    Args:
        executor: Runner of the tasks.
        function: Function of one task; its results are dropped.
        tasks: Arguments.
    """
    for _ in executor.completed(function, tasks):
        pass


def run_in_order(
    executor: Executor, function: Callable[[Task], Result], tasks: Sequence[Task]
) -> list[Result]:
    """Call `function(task)` for each task; return the results in the order of the tasks.

    Args:
        executor: Runner of the tasks.
        function: Function of one task.
        tasks: Arguments.
    """
    found = dict(executor.completed(function, tasks))
    return [found[i] for i in range(len(tasks))]


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
