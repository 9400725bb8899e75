"""The `equipoise` command: parse, call, print.

Each verb has a file of its own. A verb reads its inputs, calls one stage, and prints the result.
Slow imports (Numba, SciPy, MuJoCo, Matplotlib) follow in the verb that needs them.
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
        failed, 130 interrupted, 141 the reader of the output has gone.
    """
    from equipoise.cli.app import app
    from equipoise.cli.output import complain

    # Characters that the terminal cannot show must not end a verb.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    code = 0
    try:
        try:
            app(args=list(sys.argv[1:] if arguments is None else arguments), prog_name="equipoise")
        except SystemExit as end:
            if isinstance(end.__context__, BrokenPipeError):
                raise end.__context__ from None
            code = end.code if isinstance(end.code, int) else int(bool(end.code))
        sys.stdout.flush()
    except EquipoiseError as error:
        complain(str(error), "error: ")
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        # Otherwise the interpreter tries at its end to write the rest again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 141  # that of a program ended by SIGPIPE
        complain(f"cannot write to standard output: {error}; make room", "error: ")
        return OutsideError.exit_code
    return code
