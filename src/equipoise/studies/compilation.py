"""Compilation of a study's kernels by short runs, here or in a parallel process.

Numba compiles one kernel at a time. With an empty cache, a second process compiles the kernels of
twin and evaluation while the first one trains. Cached kernels load within a second or two.
"""

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import Any, Final

from equipoise.control.bound_policy import bind_policy
from equipoise.control.policy import TaskPolicy, shipped_policy
from equipoise.executors import available_cores
from equipoise.jit import cache_is_empty, watching_compilation
from equipoise.learning.train import train
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import MODEL, World
from equipoise.settings import Settings
from equipoise.studies.progress import ProgressReporter, Show
from equipoise.worlds.evaluation import evaluate

MOMENT: Final = 0.02
"""Duration of an episode or a trial that runs only for the compilation [s]."""
FUNCTIONS: Final = 82
"""Number of functions that training and evaluation compile; it only scales a progress bar."""
TWIN_FUNCTIONS: Final = 31
"""Number of functions that the twin compiles in addition; it only scales a progress bar."""


@contextmanager
def compiling_in_parallel() -> Generator[None]:
    """Compile kernels in a parallel process, if the cache is empty and a second core is available.

    If that process fails, each kernel is compiled at its first call.
    """
    process, command = None, [sys.executable, "-m", __name__]
    if cache_is_empty() and available_cores() > 1:
        quiet: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        with suppress(OSError):
            process = subprocess.Popen(command, **quiet)
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


@contextmanager
def compiling(show: Show, functions: int, stage: str = "compile") -> Generator[None]:
    """Show the compilation in this context as a stage.

    Args:
        show: Called with the progress.
        functions: Number of functions to compile with an empty cache.
        stage: Name of the stage.
    """
    count = 0

    def compiled() -> None:
        nonlocal count
        count += 1
        text = f"{count} functions, once on this machine"
        show(ProgressReporter(stage, min(count, functions - 1), functions, text=text))

    show(ProgressReporter(stage, 0, functions))
    with watching_compilation(compiled):
        yield
    text = f"{count} functions, once on this machine" if count else "done before, loaded"
    show(ProgressReporter(stage, functions, functions, text=text))


def compile_training(arm: Arm, settings: Settings) -> None:
    """Compile the kernels of training and evaluation, for one arm."""
    tree = settings.model_dump()
    tree["learning"] |= {"episodes": 1, "episode_duration": MOMENT}
    tree["selection"] |= {"every": 1, "rounds": 1, "duration": MOMENT}
    tree["evaluation"] = {}
    train(shipped_pendulum(), arm, Settings.model_validate(tree))


def compile_trials(policy: TaskPolicy, world: str | World = MODEL) -> None:
    """Compile the kernels that run a policy in a world; a policy without a kernel is not called."""
    tree = policy.settings.model_dump()
    tree["evaluation"] |= {"trials": 1, "duration": MOMENT}
    runs = policy if policy.kernel else bind_policy(lambda _: 0.0, arm=policy.arm)
    evaluate(runs, Settings.model_validate(tree), world=world, with_baselines=False)


def compile_kernels() -> None:
    """Compile the kernels of twin and evaluation, for the shipped policy."""
    compile_trials(shipped_policy(), "twin:nominal")
    compile_trials(shipped_policy())


if __name__ == "__main__":
    compile_kernels()
