"""Compilation of all kernels, before somebody waits for them.

Each job does a little of everything that a user does, in a process of its own: processes compile at
the same time, which threads cannot. All verbs and environments of a user share the machine code, as
long as the sources of the package are equal (`equipoise.jit`).
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from typing import Final

from equipoise.control.policy import shipped_policy
from equipoise.errors import OutsideError
from equipoise.executors import Show
from equipoise.identification.swing import identify
from equipoise.jit import DISABLED, kernel_folder
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


JOBS: Final = (train_a_little, run_a_little)
"""Jobs of the processes; they share few kernels."""


def _marker() -> Path:
    return kernel_folder() / "warm"


def is_warm() -> bool:
    """Return whether the kernels of these sources were compiled by `warm_up`."""
    return DISABLED or _marker().exists()


def warm_up(workers: int, show: Show = lambda *_: None) -> None:
    """Compile the kernels of the pipeline, of twins and of runs into the cache.

    Args:
        workers: Maximum number of processes.
        show: Called with the progress.

    Raises:
        OutsideError: A process ended early.
    """
    begin, context = time.monotonic(), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as pool:
        jobs = [pool.submit(job) for job in JOBS]
        while not all(job.done() for job in jobs):
            wait(jobs, timeout=REFRESH)
            show("compile", None, f"once on this machine: {time.monotonic() - begin:.0f} s")
    try:
        for job in jobs:
            job.result()
    except BrokenProcessPool:
        raise OutsideError("a process of the compilation ended early; repeat the command") from None
    with suppress(OSError):  # a cache that cannot be written
        _marker().touch()
    show("compile", 1.0, "once on this machine")
