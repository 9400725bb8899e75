"""`equipoise warm-up`: compiles all kernels at once, so that no later command waits for them."""

import time

from equipoise.cli.output import Output
from equipoise.cli.verb import verb


@verb
def warm_up(output: Output) -> None:
    """Compile all kernels once, on all cores, so that every verb starts at once.

    Half a minute on two cores. All environments of a user share the machine
    code; another version of the package needs its own.
    """
    from equipoise.executors import available_cores
    from equipoise.jit import cache_directory
    from equipoise.reproduction.warm_up import warm_up

    begin = time.perf_counter()
    with output.progress() as show:
        warm_up(available_cores(), show)
    output.result(
        compiled_s=round(time.perf_counter() - begin, 1),
        cache=cache_directory(),
        then="reproduce",
    )
