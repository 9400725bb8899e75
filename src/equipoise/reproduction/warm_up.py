"""Compilation of all kernels, before somebody waits for them.

Each job does a little of everything that a user does, in a process of its own: processes compile at
the same time, which threads cannot. All verbs and environments of a user share the machine code, as
long as the sources of the package are equal (`equipoise.jit`).
"""

import multiprocessing
from contextlib import suppress
from pathlib import Path
from typing import Final

from equipoise.arm.iiwa import iiwa
from equipoise.control.policy import shipped_policy
from equipoise.errors import OutsideError
from equipoise.executors import Show
from equipoise.identification.swing import identify
from equipoise.jit import DISABLED, kernel_folder
from equipoise.learning.train import train_to_target
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.rig.simulate import simulate_run
from equipoise.settings import HANGING, Settings, changed
from equipoise.simulation.evaluation import evaluate

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
    hanging = changed(policy.settings, {"evaluation.start": HANGING})
    simulate_run(policy, world=TWIN, duration=SECONDS, settings=hanging)


def _marker() -> Path:
    return kernel_folder() / "warm"


def is_warm() -> bool:
    """Return whether the kernels of these sources were compiled by `warm_up`."""
    return DISABLED or _marker().exists()


def warm_up(show: Show = lambda *_: None) -> None:
    """Compile the kernels of the pipeline, of twins and of runs into the cache.

    Args:
        show: Called at the begin and at the end.

    Raises:
        OutsideError: A process ended early.
    """
    context, text = multiprocessing.get_context("spawn"), "half a minute, once on this machine"
    processes = [context.Process(target=job) for job in (train_a_little, run_a_little)]
    show("compile", None, text)
    try:
        for process in processes:
            process.start()
        for process in processes:
            process.join()
            if process.exitcode:
                raise OutsideError(f"a compilation ended with exit code {process.exitcode}")
    finally:
        for process in processes:
            if process.pid is not None:
                process.terminate()
    with suppress(OSError):  # a cache that cannot be written
        _marker().touch()
    show("compile", 1.0, text)
