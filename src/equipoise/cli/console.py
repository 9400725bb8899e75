"""`equipoise console`: shows the runs on this computer in the browser, with their questions."""

from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.cli.verb import verb


@verb
def console(output: Output, *, page: opt.Page) -> None:
    """Show the runs on this computer in the browser, with all buttons, until Ctrl-C.

    Open the printed address, token included. The console shows each run of
    deploy --robot that you have started on this computer, and waits for the
    next one. STOP and the space bar stop the arm. A run does not depend on the
    console.
    """
    from equipoise.apps.console.server import serve

    def ready(address: str) -> None:
        output.result(console=address)

    with signals() as stopped:
        serve(page.listen, page.port, ready, stopped.is_set)
