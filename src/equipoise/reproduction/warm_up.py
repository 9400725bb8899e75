"""Compilation of all kernels, before somebody waits for them.

Each job does a little of everything that a user does, in a process of its own: two processes
compile at the same time, which threads cannot. All verbs and environments of a user share
the machine code, as long as the sources of the package are equal (`equipoise.jit`).
"""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Final

from equipoise.control.policy import shipped_policy
from equipoise.identification.swing import identify
from equipoise.learning.target import train_to_target
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.reproduction.pipeline import TWIN, changed
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.rig.simulate import simulate_run
from equipoise.settings import Settings
from equipoise.worlds.evaluation import evaluate

SECONDS: Final = 0.5
"""Length of trials and runs [s]: long enough for every branch of a tick."""
LITTLE: Final = {
    "learning.episodes": 40,
    "selection.every": 20,
    "selection.rounds": 1,
    "selection.round_trials": 2,
    "selection.duration": SECONDS,
    "selection.test_trials": 2,
    "evaluation.trials": 2,
    "evaluation.duration": SECONDS,
}
"""Settings of the little work."""


def train_a_little() -> None:
    """Identify, train and evaluate on the plants."""
    pendulum = identify(synthetic_swing())
    train_to_target(pendulum, iiwa(7), changed(Settings(), LITTLE), target=0.0, learners=1)
    policy = shipped_policy()
    for world in (MODEL, IDEAL):
        evaluate(policy, changed(policy.settings, LITTLE), world=world)


def run_a_little() -> None:
    """Evaluate and run on the digital twin."""
    policy = shipped_policy()
    evaluate(policy, changed(policy.settings, LITTLE), world=TWIN)
    for world in (TWIN, MODEL):
        simulate_run(policy, world=world, duration=SECONDS)


JOBS: Final[dict[str, Callable[[], None]]] = {"train": train_a_little, "run": run_a_little}
"""Jobs by name; they share few kernels."""


def warm_up(workers: int, done: Callable[[str], None] = lambda _: None) -> None:
    """Compile the kernels of the pipeline, of twins and of runs into the cache.

    Args:
        workers: Maximum number of processes.
        done: Callback; receives the name of each finished job.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(JOBS)), mp_context=context) as pool:
        jobs = {pool.submit(job): name for name, job in JOBS.items()}
        for job in as_completed(jobs):
            job.result()
            done(jobs[job])
