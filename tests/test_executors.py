"""Execution of independent tasks."""

import threading
import time

import pytest

from equipoise.executors import ThreadExecutor, available_cores, run_all, run_in_order

WORKERS = pytest.mark.parametrize("workers", [1, 3])


@WORKERS
def test_every_task_runs_once_and_results_come_in_order(workers):
    ran = []

    def square(task):
        ran.append(task)
        return task**2

    tasks = range(10, 110)
    assert run_in_order(ThreadExecutor(workers), square, tasks) == [task**2 for task in tasks]
    assert sorted(ran) == list(tasks)


@WORKERS
def test_no_task_is_no_result(workers):
    assert run_in_order(ThreadExecutor(workers), abs, []) == []


@WORKERS
def test_an_error_ends_the_work_on_all_cores(workers):
    begun = []

    def fail(item):
        begun.append(item)
        raise ValueError(item)

    with pytest.raises(ValueError, match=r"^[0-2]$"):
        run_all(ThreadExecutor(workers), fail, range(1000))
    assert len(begun) <= workers


@WORKERS
def test_closing_the_results_ends_the_work(workers):
    begun = []

    def wait(task):
        begun.append(task)
        time.sleep(0.01)

    results = ThreadExecutor(workers).completed(wait, range(10_000))
    next(results)
    results.close()
    assert len(begun) < 10_000


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
