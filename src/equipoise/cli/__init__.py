"""The `equipoise` command: parse, call, print.

Each verb has a file of its own. A verb reads its inputs, calls one stage or study, prints the
result, and names the next command. Slow imports (Numba, SciPy, MuJoCo, Matplotlib) follow the first
words of the verb that needs them.
"""

import io
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TextIO

from equipoise.errors import INTERRUPTED, ClosedPipeError, OutsideError
from equipoise.printable import printable


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments after `equipoise`; by default those of the shell.

    Returns:
        The exit code: 0 done, 1 the result is bad, 2 wrong use or bad input, 3 the outside world
        failed, 130 interrupted, 141 the reader of the output has gone.
    """
    try:
        code = _run(arguments)
        if code == INTERRUPTED and arguments is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interpreter is about to end
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()
    except OSError as error:
        if not _cut_off(sys.stdout):
            raise
        if isinstance(error, BrokenPipeError):
            return ClosedPipeError.exit_code
        with suppress(OSError):
            print(
                f"error: cannot write to standard output: {error.strerror}; make room, or send it "
                "elsewhere",
                file=sys.stderr,
            )
        return OutsideError.exit_code
    return code


def _run(arguments: Sequence[str] | None) -> int:
    # Characters that the terminal cannot show must not end a verb.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        from equipoise.cli.app import app
        from equipoise.cli.output import command_line

        command_line[:] = sys.argv[1:] if arguments is None else arguments
        app(args=list(command_line), prog_name="equipoise")
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):
            return ClosedPipeError.exit_code
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(printable(str(end.code)), file=sys.stderr)
        return 1
    return 0


def _cut_off(stream: TextIO | None) -> bool:
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
