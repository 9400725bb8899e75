"""`equipoise log show`: replays a run in the browser."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.cli.verb import verb


@verb
def show(output: Output, run: Path, *, page: opt.Page) -> None:
    """Replay a run in the browser: the arm in 3-D, plots, events, until Ctrl-C.

    Open the printed address, token included. The page plays the run at 0.1 to 4
    times its speed, steps by a tick, and jumps to events. A truncated log is
    shown as far as it is readable.
    """
    from equipoise.apps.console.replay import show_run
    from equipoise.logs.run_log import RunLog

    log = RunLog.load(run, damaged=True)

    def ready(address: str) -> None:
        output.result(run=run, replay=address, warnings=[log.damage])

    with signals() as stopped:
        show_run(log, run.stem, page.listen, page.port, ready, stopped.is_set)
