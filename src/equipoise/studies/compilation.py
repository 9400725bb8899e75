"""Compile what a study needs later, in a process beside it.

Numba compiles one kernel at a time. On a machine where nothing has been compiled yet, a second
process fills the cache with the kernels of twin and evaluation while the first one trains.
"""

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress

from equipoise.compiled import cache_is_empty
from equipoise.control.policy import shipped_policy
from equipoise.deployment import deploy
from equipoise.evaluation import evaluate
from equipoise.learning.trials import available_cores
from equipoise.settings import Settings


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


def compile_kernels() -> None:
    """Have the kernels of twin and evaluation compiled, by running each for a moment."""
    policy, moment = shipped_policy(), 0.02
    deploy(policy, world="twin:nominal", duration=moment)
    tree = policy.settings.model_dump()
    tree["evaluation"] |= {"trials": 1, "duration": moment}
    evaluate(policy, Settings.model_validate(tree), with_yardsticks=False)


if __name__ == "__main__":
    compile_kernels()
