"""Computations of the loop's process that may take longer than a tick: jobs, and slow policies."""

import multiprocessing
import signal
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import Policy
from equipoise.control.self_test import SelfTest, self_test
from equipoise.control.ticks import Job
from equipoise.errors import OutsideError
from equipoise.model.pendulum import PendulumParameters
from equipoise.rig.signals import ignore_signals, start_process

Array = npt.NDArray[np.float64]
T = TypeVar("T")

POLL_PERIOD: Final = 0.010
"""Time between two looks at another process [s]."""
JOIN_TIMEOUT: Final = 5.0
"""Time for a process to end by itself [s]."""


class WorkerProcess:
    """Process for jobs longer than a tick, started before the stream.

    It runs a self-test once, so that in the stream all its code is loaded.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # A daemon ends with this process.
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        start_process(self._process)
        theirs.close()
        self.begin(_practise)
        while (result := self.result()) is None:
            time.sleep(POLL_PERIOD)
        if isinstance(result, Exception):
            self.close()
            raise OutsideError(f"the process for the self-test does not work ({result})")

    def begin(self, job: Job) -> None:
        """Send a job to the worker; `result` returns the error of a worker that has ended."""
        try:
            self._pipe.send(job)
        except OSError:
            return

    def result(self) -> Any:
        """Return the result of the job, once; an exception where the worker failed."""
        try:
            return self._pipe.recv() if self._pipe.poll() else None
        except (EOFError, OSError) as error:
            return error

    def close(self) -> None:
        """End the worker."""
        self._pipe.close()
        self._process.join(JOIN_TIMEOUT)
        if self._process.is_alive():
            self._process.kill()


def _practise() -> SelfTest:
    """Run a self-test on an artificial swing."""
    time_ = np.linspace(0.0, 6.0, 1200)
    counts, move = np.round(200.0 * np.sin(8.4 * time_)), 0.04 / (1.0 + np.exp(8.4 - 12.0 * time_))
    with np.errstate(all="ignore"):
        return self_test(
            time_,
            counts,
            time_,
            move,
            pendulum=PendulumParameters(70.2, 7.16, 0.15),
            counts_per_rev=8192,
            resting=0.0,
            delay=0.0,
        )


def _work(pipe: Any) -> None:
    """Run the worker's process: execute jobs until the loop ends."""
    ignore_signals()
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(job())
        except Exception as error:  # the run stops on it
            pipe.send(RuntimeError(str(error)))


class PolicyTimeout(KeyboardInterrupt):
    """Time limit of a policy exceeded: an interruption from outside, which `guest_code` passes on.

    No handler of `Exception` in the policy catches it.
    """


class InterruptedPolicy:
    """Policy with a time limit per call, enforced by a timer of the system.

    The timer interrupts Python code in the main thread; compiled code returns first.
    """

    def __init__(self, policy: Policy, limit: float) -> None:
        """Limit the time of each call of `policy` to `limit` [s]."""
        self._policy, self._limit, self._running = policy, limit, False
        signal.signal(signal.SIGALRM, self._interrupt)

    def reset(self) -> None:
        """Reset the policy."""
        self._within(self._policy.reset)

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation, shape (4,).

        Raises:
            PolicyTimeout: The call exceeds the time limit.
        """
        return self._within(partial(self._policy.act, observation))

    def _within(self, call: Callable[[], T]) -> T:
        try:
            self._running = True
            signal.setitimer(signal.ITIMER_REAL, self._limit)
            return call()
        finally:
            self._running = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _interrupt(self, *_: object) -> None:
        if self._running:
            raise PolicyTimeout(f"it took more than {1e3 * self._limit:.1f} ms")
