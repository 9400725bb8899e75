"""`equipoise log show`: replays a run in the browser."""

import sys
from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output, stop_by_signal, verb


@verb
def show(
    run: Path = opt.RUN,
    listen: str = opt.LISTEN,
    port: int = opt.PORT,
    as_json: bool = opt.JSON,
) -> None:
    """Replay a run in the browser: the arm in 3-D, plots, events, until Ctrl-C.

    Open the printed address, token included. The page plays the run at 0.1 to 4
    times its speed, steps by a tick, and jumps to the events that log explain
    names. A truncated log is shown as far as it is readable.
    """
    output = Output(as_json)
    output.say(f"Showing {run}")

    from equipoise.apps.console.replay import show_run
    from equipoise.logs.run_log import RunLog

    log = RunLog.load(run, damaged=True)
    output.warn(log.damage)

    def ready(address: str) -> None:
        output.rows({"replay": address, "": "Ctrl-C ends it"})
        output.result(run=run, replay=address)
        sys.stdout.flush()

    with stop_by_signal() as stopped:
        show_run(log, run.stem, listen, port, ready, stopped)
