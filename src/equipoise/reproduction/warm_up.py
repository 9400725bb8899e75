"""Compilation of all kernels, before somebody waits for them.

Each job does a little of everything that a user does, in a process of its own: processes compile at
the same time, which threads cannot. All verbs and environments of a user share the machine code, as
long as the sources of the package are equal (`equipoise.jit`).
"""

import multiprocessing
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty
from typing import Any, Final

from equipoise.control.policy import shipped_policy
from equipoise.errors import OutsideError
from equipoise.executors import Show
from equipoise.identification.swing import identify
from equipoise.jit import disabled, kernel_folder, watching_compilation
from equipoise.learning.train import train_to_target
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.rig.simulate import simulate_run
from equipoise.settings import Settings, changed
from equipoise.worlds.evaluation import evaluate

TWIN: Final = "twin:nominal"
"""World of the reproduction's evaluations on the twin and of its runs."""
SECONDS: Final = 0.5
"""Length of trials and runs [s]: long enough for every branch of a tick."""
LITTLE: Final = {
    "learning.episodes": 40,
    "selection.every": 20,
    "selection.trials": 2,
    "selection.duration": SECONDS,
    "selection.test_trials": 2,
    "evaluation.trials": 2,
    "evaluation.duration": SECONDS,
}
"""Settings of the little work."""
REFRESH: Final = 0.2
"""Time between two reports of the progress [s]."""


def train_a_little() -> None:
    """Identify, train, evaluate and run on the plants."""
    pendulum = identify(synthetic_swing())
    train_to_target(pendulum, iiwa(7), changed(Settings(), LITTLE), target=0.0, attempts=1)
    policy = shipped_policy()
    for world in (MODEL, IDEAL):
        evaluate(policy, changed(policy.settings, LITTLE), world=world)
    simulate_run(policy, world=MODEL, duration=SECONDS)


def run_a_little() -> None:
    """Evaluate and run on the digital twin."""
    policy = shipped_policy()
    evaluate(policy, changed(policy.settings, LITTLE), world=TWIN)
    simulate_run(policy, world=TWIN, duration=SECONDS)


JOBS: Final[dict[str, Callable[[], None]]] = {"train": train_a_little, "run": run_a_little}
"""Jobs by name; they share few kernels."""
KERNELS: Final = {
    **{"plant.step": 3.4, "trial.run_trial": 1.9, "ideal.run_trials": 1.7},
    **{"episodes.train_episodes": 1.6, "trial.new_twin_handle": 1.4},
    **{"trial.advance_trial": 1.1, "episodes.new_training_loop": 1.0},
}
"""Compilation of the large kernels [s]."""
OTHER: Final = 0.12
"""Compilation of any other function, in the mean [s]."""
FUNCTIONS: Final = 261
"""Number of all functions."""
IMPORT: Final = 2.0
"""Time from the start of the processes to the first function [s]."""


def _marker() -> Path:
    return kernel_folder() / "warm"


def is_warm() -> bool:
    """Return whether the kernels of these sources were compiled by `warm_up`."""
    return disabled() or _marker().exists()


def _process(name: str, compiled: Any) -> None:
    with watching_compilation(compiled.put):
        JOBS[name]()


def warm_up(workers: int, show: Show = lambda *_: None) -> None:
    """Compile the kernels of the pipeline, of twins and of runs into the cache.

    Args:
        workers: Maximum number of processes.
        show: Called with the progress, which is linear in time.

    Raises:
        OutsideError: A process ended early.
    """
    context, begin = multiprocessing.get_context("spawn"), time.monotonic()
    compiled: Any = context.Queue()
    waiting, running, left = list(JOBS), dict[str, Any](), dict(KERNELS)
    done, last = len(JOBS) * IMPORT, begin + IMPORT
    total = done + sum(KERNELS.values()) + (FUNCTIONS - len(KERNELS)) * OTHER
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                name = waiting.pop(0)
                running[name] = context.Process(target=_process, args=(name, compiled))
                running[name].start()
            with suppress(Empty):
                name = compiled.get(timeout=REFRESH)
                done, last = done + left.pop(name, OTHER), time.monotonic()
            for name, process in list(running.items()):
                if process.exitcode:
                    raise OutsideError(f"the compilation of {name!r} ended: {process.exitcode}")
                if process.exitcode == 0:
                    running.pop(name)
            now = time.monotonic()
            # While a large kernel compiles, nothing is reported: go on at the same rate.
            rate = done / max(last - begin, 1.0)
            ahead = min(rate * (now - last), max(left.values(), default=OTHER))
            show("compile", min((done + ahead) / total, 0.99), "once on this machine")
    finally:
        for process in running.values():
            process.terminate()
    with suppress(OSError):  # a cache that cannot be written
        _marker().touch()
    show("compile", 1.0, "once on this machine")
