"""The `equipoise` command: parse, call, print.

A verb reads its inputs, calls one stage, and prints the result. Slow imports (Numba, SciPy, MuJoCo,
Matplotlib) follow in the verb that needs them.
"""

import io
import os
import sys
from collections.abc import Sequence

from equipoise.errors import INTERRUPTED, EquipoiseError, OutsideError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments after `equipoise`; by default those of the shell.

    Returns:
        The exit code: 0 done, 1 the result is bad, 2 wrong use or bad input, 3 the outside world
        failed, 130 interrupted.
    """
    # Characters that the terminal cannot show must not end a verb.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    from equipoise.cli.app import app
    from equipoise.cli.output import complain

    code, message = 0, ""
    try:
        app(args=arguments, prog_name="equipoise")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    except EquipoiseError as error:
        code, message = error.exit_code, str(error)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except OSError as error:
        code = OutsideError.exit_code
        message = f"a file or a link failed: {error}; check it, and repeat the command"
    try:
        sys.stdout.flush()
    except OSError as error:
        # Otherwise the interpreter tries at its end to write the rest again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = OutsideError.exit_code
        if not isinstance(error, BrokenPipeError):  # of a reader such as head, which has enough
            message = f"cannot write to standard output: {error}; make room"
    if message:
        complain(message, "error: ")
    return code
