"""`equipoise console`: shows the runs on this computer in the browser, with their questions."""

import sys
from collections.abc import Generator
from contextlib import contextmanager

from equipoise.cli import options as opt
from equipoise.cli.output import Output, stop_by_signal, verb

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
