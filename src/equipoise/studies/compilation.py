"""Compile the kernels of a study: by running each for a moment, here or in a process beside.

Numba compiles one kernel at a time. On a machine where nothing has been compiled yet, a second
process fills the cache with the kernels of twin and evaluation while the first one trains. Where
the kernels are in the cache, they are only loaded, in a second or two.
"""

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import Final

from equipoise.compiled import cache_is_empty, watching_compilation
from equipoise.control.bound_policy import bind_policy
from equipoise.control.policy import TaskPolicy, shipped_policy
from equipoise.evaluation import evaluate
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.sim_configs import MODEL, World
from equipoise.settings import Settings
from equipoise.simulation import available_cores
from equipoise.studies.progress import ProgressReporter, Show
from equipoise.training import train

MOMENT: Final = 0.02
"""Duration of an episode or a trial that only has its kernels compiled [s]."""
FUNCTIONS: Final = 82
"""Number of functions that training and evaluation compile; it only scales a progress bar."""
TWIN_FUNCTIONS: Final = 31
"""Number of functions that the twin compiles in addition; it only scales a progress bar."""


@contextmanager
def compiling_beside() -> Generator[None]:
    """Compile kernels beside what is done in this context, if need be and with a core to spare.

    The process beside is a convenience: where it cannot be, or fails, each kernel is compiled when
    it is needed.
    """
    beside = None
    if cache_is_empty() and available_cores() > 1:
        quiet = subprocess.DEVNULL
        with suppress(OSError):
            beside = subprocess.Popen(
                [sys.executable, "-m", __name__], stdin=quiet, stdout=quiet, stderr=quiet
            )
    try:
        yield
    finally:
        if beside is not None:
            beside.kill()
            beside.wait()


@contextmanager
def compiling(show: Show, functions: int, stage: str = "compile") -> Generator[None]:
    """Show as a stage that kernels are compiled in this context, or loaded from the cache.

    Args:
        show: Called with the progress.
        functions: Number of functions that are compiled where the cache is empty.
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
    """Have the kernels of training and evaluation compiled, for one arm."""
    tree = settings.model_dump()
    tree["learning"] |= {"episodes": 1, "episode_duration": MOMENT}
    tree["selection"] |= {
        "every": 1,
        "screening_trials": 1,
        "finalists": 1,
        "final_trials": 1,
        "duration": MOMENT,
        "final_duration": MOMENT,
    }
    train(shipped_pendulum(), arm, Settings.model_validate(tree))


def compile_trials(policy: TaskPolicy, world: str | World = MODEL) -> None:
    """Compile the kernels that run a policy in a world; a policy without a kernel is not called."""
    settings = _moment(policy.settings)
    runs = policy if policy.kernel else bind_policy(lambda _: 0.0, arm=policy.arm)
    evaluate(runs, settings, world=world, with_baselines=False)


def compile_kernels() -> None:
    """Have the kernels of twin and evaluation compiled, for the policy that ships."""
    compile_trials(shipped_policy(), "twin:nominal")
    compile_trials(shipped_policy())


def _moment(settings: Settings) -> Settings:
    tree = settings.model_dump()
    tree["evaluation"] |= {"trials": 1, "duration": MOMENT}
    return Settings.model_validate(tree)


if __name__ == "__main__":
    compile_kernels()
