"""The rule for a training that was interrupted, for all verbs that train."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from equipoise.cli.destinations import Destination, check_output
from equipoise.cli.output import Interrupted
from equipoise.errors import InputError


@contextmanager
def unfinished(destination: Destination, *, resume: bool) -> Generator[Path]:
    """Keep to the rule for interrupted trainings while one is made and saved.

    A checkpoint is resumed where the user asks for that and replaced with `--force`; else the verb
    is refused. It goes away when this context ends well.

    Args:
        destination: The policy that is written.
        resume: Whether to go on from a checkpoint.

    Yields:
        File for the checkpoints, beside the policy.

    Raises:
        InputError: There is a checkpoint and it is not asked for, or the other way round.
        Interrupted: The training was interrupted.
    """
    from equipoise.artefacts import partial_path

    partial = partial_path(destination.path)
    check_output(partial)
    if resume and not partial.exists():
        raise InputError(
            f"there is no interrupted training in {partial}; leave out --resume to begin one"
        )
    if partial.exists() and not resume:
        if not destination.force:
            raise InputError(
                f"{partial} holds an interrupted training; go on with it by --resume, give another "
                "--out, or begin anew with --force"
            )
        partial.unlink()
    try:
        yield partial
    except KeyboardInterrupt:
        if not partial.exists():
            raise
        named = ("--out", str(destination.path)) if destination.number > 1 else ()
        raise Interrupted(*named, "--resume") from None
    partial.unlink(missing_ok=True)
