"""Execution of independent tasks in threads, and their progress.

A result does not depend on the number of threads. Compiled kernels release the interpreter, so that
threads use all cores.
"""

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from threading import Lock
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
Show = Callable[[str, float | None, str], None]
"""Callback for the progress of a stage, also from other threads: its name, the completed fraction
(None while it is unknown), and its state in a few words."""


def completed(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Generator[tuple[int, Result]]:
    """Call a function for each task, and yield the results as they complete.

    Args:
        function: Function of one task, called in any thread.
        tasks: Arguments.
        workers: Number of threads; a single one is the caller's.

    Yields:
        Index of the task, and its result. An error of a task is raised here. After it, or once the
        generator is closed, no further task begins.
    """
    if workers == 1:
        for i, task in enumerate(tasks):
            yield i, function(task)
        return
    pool = ThreadPoolExecutor(workers)
    try:
        index_of = {pool.submit(function, task): i for i, task in enumerate(tasks)}
        for future in as_completed(list(index_of)):
            yield index_of.pop(future), future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def counted(stage: str, total: int, show: Show) -> Callable[[float], None]:
    """Return a callback that counts finished trials.

    Args:
        stage: Name of the stage.
        total: Number of all trials.
        show: Called with the progress.
    """
    lock, finished = Lock(), 0.0

    def done(more: float) -> None:
        nonlocal finished
        with lock:
            finished += more
            whole = int(finished + 1e-6)  # without the rounding of fractions
            show(stage, min(finished / total, 1.0), f"{whole:,} of {total:,} trials")

    return done
