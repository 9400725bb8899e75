"""Progress of trials on the terminal, with the compilation before them."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from equipoise.cli.output import Output

if TYPE_CHECKING:
    from equipoise.control.policy import TaskPolicy
    from equipoise.evaluation import Done


@contextmanager
def trial_bar(
    output: Output, name: str, total: int, compile: Callable[[], None], functions: int
) -> "Generator[Done]":
    """Compile kernels, then show the number of finished trials; both are stages.

    Args:
        output: Output of the verb.
        name: Name of the stage of the trials.
        total: Number of trials.
        compile: Compiles the kernels of the trials.
        functions: Number of functions to compile with an empty cache.
    """
    from equipoise.studies.compilation import compiling
    from equipoise.studies.progress import counted

    with output.stages() as show:
        with compiling(show, functions):
            compile()
        yield counted(name, total, show)


@contextmanager
def trials_of(
    output: Output, name: str, policy: "TaskPolicy", world: str, total: int
) -> "Generator[Done]":
    """Show the progress of a policy's trials in a world, as `trial_bar`."""
    from equipoise.model.sim_configs import MODEL
    from equipoise.studies.compilation import FUNCTIONS, TWIN_FUNCTIONS, compile_trials

    functions = FUNCTIONS if world == MODEL else FUNCTIONS + TWIN_FUNCTIONS
    with trial_bar(output, name, total, lambda: compile_trials(policy, world), functions) as done:
        yield done
