"""The `equipoise` command: parse, call, print.

Each verb has a file of its own. A verb reads its inputs, calls one stage, and prints the result.
Slow imports (Numba, SciPy, MuJoCo, Matplotlib) follow in the verb that needs them.
"""

import io
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from typing import Any, Final

from equipoise.errors import INTERRUPTED, EquipoiseError, OutsideError

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
    from equipoise.cli.output import complain

    stdout: Any = sys.stdout
    with suppress(io.UnsupportedOperation):  # a notebook's has no number
        raw = _StandardOutput(stdout.fileno(), "w", closefd=False)
        stdout = io.TextIOWrapper(io.BufferedWriter(raw), stdout.encoding)
    # Characters that the terminal cannot show must not end a verb.
    for stream in (stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    code = 0
    try:
        from equipoise.cli.app import app

        with redirect_stdout(stdout):
            try:
                app(args=sys.argv[1:] if arguments is None else arguments, prog_name="equipoise")
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(bool(end.code))
            stdout.flush()
    except EquipoiseError as error:
        if error.exit_code != READER_GONE:
            complain(str(error), "error: ")
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        complain(f"a file or a link failed: {error}; check it, and repeat the command", "error: ")
        return OutsideError.exit_code
    return code


class _StandardOutput(io.FileIO):
    def write(self, data: Any) -> int | None:
        """Write bytes.

        Raises:
            OutsideError: They cannot be written, or nobody reads them.
        """
        try:
            return super().write(data)
        except OSError as failure:
            # Otherwise the interpreter tries at its end to write the rest again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            error = OutsideError(f"cannot write to standard output: {failure}; make room")
            if isinstance(failure, BrokenPipeError):
                error.exit_code = READER_GONE
            raise error from None
