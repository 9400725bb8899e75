"""The `equipoise` command: parse, call, print.

Each verb has a file of its own. A verb reads its inputs, calls one stage, and prints the result.
Slow imports (Numba, SciPy, MuJoCo, Matplotlib) follow in the verb that needs them.
"""

import io
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TextIO

from equipoise.errors import CLOSED_PIPE, INTERRUPTED, EquipoiseError, OutsideError
from equipoise.printable import printable


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments after `equipoise`; by default those of the shell.

    Returns:
        The exit code: 0 done, 1 the result is bad, 2 wrong use or bad input, 3 the outside world
        failed, 130 interrupted, 141 the reader of the output has gone.
    """
    # Characters that the terminal cannot show must not end a verb.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        code = _run(sys.argv[1:] if arguments is None else arguments)
        if code == INTERRUPTED and arguments is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interpreter is about to end
        sys.stdout.flush()
    except OSError as error:
        if not _rejects(sys.stdout):
            raise
        if isinstance(error, BrokenPipeError):
            return CLOSED_PIPE
        with suppress(OSError):
            message = f"error: cannot write to standard output: {error.strerror}; make room"
            print(message, file=sys.stderr)
        return OutsideError.exit_code
    return code


def _run(arguments: Sequence[str]) -> int:
    from equipoise.cli.app import app
    from equipoise.cli.output import complain

    try:
        app(args=list(arguments), prog_name="equipoise")
    except EquipoiseError as error:
        complain(str(error), "error: ")
        return error.exit_code
    except MemoryError:
        complain("there is not enough memory; ask for less, or free some", "error: ")
        return OutsideError.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):
            return CLOSED_PIPE
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(printable(str(end.code)), file=sys.stderr)
        return 1
    return 0


def _rejects(stream: TextIO) -> bool:
    """Return whether a stream rejects output; discard the rest of the output if so."""
    if not isinstance(stream, io.TextIOWrapper):
        return False
    try:
        os.write(stream.fileno(), b"\n")  # text that failed once is gone, so `flush` may succeed
    except OSError:
        # Otherwise the interpreter tries again at its end, and complains.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
        return True
    return False
