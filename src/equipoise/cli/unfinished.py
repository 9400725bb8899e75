"""The rule for interrupted trainings, for all verbs that train."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from equipoise.cli.destinations import Destination, check_output
from equipoise.cli.output import Interrupted
from equipoise.errors import InputError


@contextmanager
def unfinished(destination: Destination, *, resume: bool) -> Generator[Path]:
    """Apply the rule for interrupted trainings while a policy is trained and saved.

    A checkpoint is resumed with `--resume` and replaced with `--force`; otherwise the verb is
    refused. The checkpoint is deleted when this context ends without an error.

    Args:
        destination: The policy that is written.
        resume: Whether to continue from a checkpoint.

    Yields:
        File for the checkpoints, beside the policy.

    Raises:
        InputError: There is a checkpoint without `--resume`, or `--resume` without a checkpoint.
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
                f"{partial} holds an interrupted training; continue it with --resume, give another "
                "--out, or replace it with --force"
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
