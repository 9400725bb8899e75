"""The `equipoise` command: parse, call, print.

A verb reads its inputs, calls one stage, and prints the result. Slow imports (Numba, SciPy, MuJoCo,
Matplotlib) follow in the verb that needs them.
"""

import io
import os
import sys
from collections.abc import Sequence
from typing import Final

from equipoise.errors import EquipoiseError, OutsideError

READER_GONE: Final = 141
"""Exit code of a program that the system ends because nobody reads its output."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments after `equipoise`; by default those of the shell.

    Returns:
        The exit code: 0 done, 1 the result is bad, 2 wrong use or bad input, 3 the outside world
        failed, 130 interrupted, 141 the reader of the output has gone.
    """
    # Otherwise files that a verb opens get the numbers of streams that the caller has closed.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115  (until the end)
    # Characters that the terminal cannot show must not end a verb.
    stdout = sys.stdout
    for stream in (stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    from equipoise.cli.output import complain

    code, message = _run(sys.argv[1:] if arguments is None else arguments)
    try:
        stdout.flush()
    except OSError as error:
        # Otherwise the interpreter tries at its end to write the rest again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stdout.fileno())
        code, message = _failed(error)
    if message:
        complain(message, "error: ")
    return code


def _run(arguments: Sequence[str]) -> tuple[int, str]:
    """Run a command; return its exit code and the message of its error."""
    from equipoise.cli.app import app

    try:
        app(args=arguments, prog_name="equipoise")
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # from rich or typer
            return READER_GONE, ""
        return (end.code if isinstance(end.code, int) else 1), ""
    except EquipoiseError as error:
        return error.exit_code, str(error)
    except OSError as error:
        return _failed(error)
    return 0, ""


def _failed(error: OSError) -> tuple[int, str]:
    if isinstance(error, BrokenPipeError):
        return READER_GONE, ""
    message = f"a file or a link failed: {error}; check it, and repeat the command"
    return OutsideError.exit_code, message
