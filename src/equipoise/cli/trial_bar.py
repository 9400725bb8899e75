"""Progress of trials on the terminal, with the compilation before them."""

from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from equipoise.cli.output import Output

if TYPE_CHECKING:
    from equipoise.control.policy import TaskPolicy
    from equipoise.evaluation import Done


@contextmanager
def trials_of(
    output: Output, name: str, policy: "TaskPolicy", world: str, total: int
) -> "Generator[Done]":
    """Compile kernels, then show the number of finished trials; both are stages.

    Args:
        output: Output of the verb.
        name: Name of the stage of the trials.
        policy: The policy.
        world: Name of the world.
        total: Number of trials.
    """
    from equipoise.model.sim_configs import IDEAL, MODEL
    from equipoise.studies.compilation import FUNCTIONS, TWIN_FUNCTIONS, compile_trials, compiling
    from equipoise.studies.progress import counted

    functions = FUNCTIONS if world in (IDEAL, MODEL) else FUNCTIONS + TWIN_FUNCTIONS
    with output.stages() as show:
        with compiling(show, functions):
            compile_trials(policy, world)
        yield counted(name, total, show)
