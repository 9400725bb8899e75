"""Execution of independent tasks in threads or on a cluster, and their progress.

A task is a function of values alone: a result depends neither on the number of workers nor on where
they are. Compiled kernels release the interpreter, so that threads use all cores. Any executor of
`concurrent.futures` takes the tasks as well; on a cluster that is Dask's.
"""

import asyncio
import functools
import logging
import os
import platform
import re
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from threading import Lock
from typing import Any, Final, TypeVar

from equipoise.errors import InputError, OutsideError, import_optional
from equipoise.files import package_versions, quoted

CONNECT_TIMEOUT: Final = 5.0
"""Maximum time until a scheduler answers [s]."""

Task = TypeVar("Task")
Result = TypeVar("Result")
Show = Callable[[str, float | None, str], None]
"""Callback for the progress of a stage, also from other threads: its name, the completed fraction
(None while it is unknown), and its state in a few words."""


def completed(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int | Executor
) -> Generator[tuple[int, Result]]:
    """Call a function for each task, and yield the results as they complete.

    Args:
        function: Function of one task, called in any thread, or pickled for an executor.
        tasks: Arguments.
        workers: Number of threads, of which a single one is the caller's; or an executor.

    Yields:
        Index of the task, and its result. An error of a task is raised here. After it, or once the
        generator is closed, no further task begins.
    """
    if workers == 1:
        for i, task in enumerate(tasks):
            yield i, function(task)
        return
    own = ThreadPoolExecutor(workers) if isinstance(workers, int) else nullcontext(workers)
    with own as executor:
        index_of = dict[Future[Result], int]()
        try:
            for i, task in enumerate(tasks):
                index_of[executor.submit(function, task)] = i
            for future in as_completed(list(index_of)):
                yield index_of.pop(future), future.result()
        finally:
            for future in index_of:
                future.cancel()


@contextmanager
def open_workers(named: str | None = None) -> Generator[int | Executor]:
    """Yield the workers that an option names, and release them at the end.

    Args:
        named: Number of threads (default: one per core); or the address of a Dask scheduler, such
            as `tcp://HOST:8786`.

    Raises:
        InputError: It is neither.
        MissingExtraError: Dask is not installed.
        OutsideError: No scheduler answers, it is lost, it has no workers, or their packages differ.
    """
    threads = available_cores() if named is None else int(named) if named.isdecimal() else 0
    if threads or named is None:
        yield threads
        return
    if not re.fullmatch(r"(tcp|tls)://\S+:\d{1,5}", named):
        raise InputError(
            f"--workers is {quoted(named)}; expected a number of threads, or the address of a Dask "
            "scheduler such as tcp://HOST:8786"
        )
    distributed = import_optional("distributed", "cluster")
    for logger in ("distributed", "distributed.client", "tornado"):  # errors are raised as well
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        with ThreadPoolExecutor(1) as thread:  # an event loop may run in this one
            thread.submit(asyncio.run, _find_scheduler(named)).result()
        client = distributed.Client(named, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except Exception as error:  # other servers, and wrong certificates, fail in many ways
        reason = str(error) or f"nothing came within {CONNECT_TIMEOUT:g} s"
        hint = "start it with: dask scheduler"
        if named.startswith("tls"):
            hint += ", and check the certificates in Dask's configuration"
        raise OutsideError(
            f"no Dask scheduler answers at {quoted(named)}: {reason}; {hint}"
        ) from None
    with client:
        try:
            found = client.run(versions, on_error="return")
            if not found:
                raise OutsideError(
                    f"the scheduler at {named} has no workers yet; start one with: dask worker "
                    f"{named}, or wait until it starts"
                )
            for worker, theirs in found.items():
                if isinstance(theirs, Exception):
                    raise OutsideError(
                        f"the worker {worker} lacks a package: {theirs}; install there what is "
                        "installed here, and start it again"
                    )
                _compare(f"the worker {worker}", theirs, versions())
            yield _Cluster(client)
        except (CancelledError, distributed.client.ClosedClientError):
            raise OutsideError(
                f"the scheduler at {named} is lost; start it again, and repeat the command"
            ) from None
        except distributed.KilledWorker as error:
            raise OutsideError(f"the workers of {named} do not survive a task: {error}") from None
        except RuntimeError as error:
            if not isinstance(error.__cause__, ImportError):
                raise
            raise OutsideError(
                f"the scheduler at {named} lacks a package: {error.__cause__}; install there what "
                "is installed here, and start it again"
            ) from None


async def _find_scheduler(address: str) -> None:
    """Raise an exception unless a scheduler answers in time; Dask's client may wait for ever."""
    import distributed

    certificates: Any = distributed.Security().get_connection_args("client")
    async with asyncio.timeout(CONNECT_TIMEOUT):
        link = await distributed.connect(address, **certificates)
        await link.write({"op": "identity", "reply": True})
        kind = (await link.read())["type"]
        await link.close()
    if kind != "Scheduler":
        raise OSError(f"a {kind} does")


class _Cluster(Executor):
    """Executor on a cluster whose workers run this version of all that determines a result."""

    def __init__(self, client: Any) -> None:
        """Take Dask's client."""
        self._client, self._executor = client, client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Pickle a call, which a scheduler then passes on as bytes, and submit it."""
        import cloudpickle

        call = cloudpickle.dumps(functools.partial(fn, *args, **kwargs))
        return self._client.sync(self._submit, call)

    async def _submit(self, call: bytes) -> Any:
        """Submit in the client's thread, which cancels all futures once the scheduler is lost."""
        if self._client.status != "running":
            raise CancelledError
        return self._executor.submit(_run_pickled, call, versions())


def _run_pickled(call: bytes, expected: dict[str, str]) -> Any:
    """Run a call in a worker, which may have joined later, if its versions are those expected."""
    import cloudpickle

    _compare(f"the worker on {platform.node()}", versions(), expected)
    return cloudpickle.loads(call)()


def _compare(worker: str, found: dict[str, str], expected: dict[str, str]) -> None:
    """Raise OutsideError if a worker has other versions than the sender of its tasks."""
    for name, version in expected.items():
        if found[name] != version:
            raise OutsideError(
                f"{worker} has {name} {found[name]}, expected {version}; install there what is "
                "installed here, and start it again"
            )


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of all that determines the bits of a result, by their packages."""
    from equipoise.jit import package_digest

    found = package_versions()
    found["equipoise"] += f" ({package_digest()})"
    return found


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
