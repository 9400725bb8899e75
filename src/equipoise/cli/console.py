"""`equipoise console`: shows the runs on this computer in the browser, with their questions."""

import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from equipoise.cli import options as opt
from equipoise.cli.output import Output, stop_by_signal, verb

if TYPE_CHECKING:
    from equipoise.apps.console.trials import ShownTrials

HINT = "STOP and the space bar stop the arm; the terminal goes on working beside it"


@verb
def console(
    listen: str = opt.LISTEN,
    port: int = opt.PORT,
    as_json: bool = opt.JSON,
) -> None:
    """Show the runs on this computer in the browser, with all buttons, until Ctrl-C.

    Open the printed address, token included. The console shows each run of
    deploy --robot and each rig emulate that you have started on this computer,
    and waits for the next one. A run does not depend on it.
    """
    output = Output(as_json)
    output.say("Console for the runs on this computer")

    from equipoise.apps.console.server import serve

    def ready(address: str) -> None:
        show_address(output, address)
        output.result(console=address)
        sys.stdout.flush()

    with stop_by_signal() as stopped:
        serve(listen, port, ready, stopped)


def show_address(output: Output, address: str) -> None:
    """Print the address of a console."""
    output.rows({"console": address, "": HINT})


@contextmanager
def beside(output: Output, wanted: bool) -> Generator[None]:
    """Run a console in a process of its own beside a verb, if wanted.

    Raises:
        MissingExtraError: viser is not installed.
        OutsideError: The console does not start.
    """
    if not wanted:
        yield
        return
    from equipoise.apps.console.server import console_process

    with console_process() as address:
        output.tell(f"  console  {address}\n           {HINT}")
        yield


@contextmanager
def trials_beside(output: Output, shown: "ShownTrials | None") -> Generator[None]:
    """Show trials in a console beside their evaluation, and after it until STOP or Ctrl-C.

    Args:
        output: The terminal.
        shown: The trials; None shows nothing.

    Raises:
        InputError: The policy cannot be sent to another process.
        MissingExtraError: viser is not installed.
        OutsideError: The console does not start.
    """
    if shown is None:
        yield
        return
    from equipoise.apps.console.server import console_process
    from equipoise.apps.console.trials import trials_process

    with console_process() as address, trials_process(shown) as process:
        output.tell(f"  console  {address}")
        result: typer.Exit | None = None
        try:
            yield
        except typer.Exit as ended:  # a bad result
            result = ended
        output.tell("The console goes on until Ctrl-C, or STOP in the browser.")
        sys.stdout.flush()
        with stop_by_signal() as stopped:
            while process.is_alive() and not stopped():
                process.join(0.1)
        if result is not None:
            raise result
