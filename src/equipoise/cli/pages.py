"""Verbs that serve a page until Ctrl-C: `equipoise console`, `play` and `log show`."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.options import verb
from equipoise.cli.output import Output, signals
from equipoise.errors import InputError


@verb
def console(output: Output, *, page: opt.Page) -> None:
    """Show the runs on this computer in the browser, with all buttons, until Ctrl-C.

    Open the printed address, token included. The console shows each run on a
    robot, real or of rig emulate, that you start on this computer; log show
    replays a run in virtual time. STOP and the space bar stop the arm. A run
    does not depend on the console.
    """
    from equipoise.console.live import serve

    with signals() as stopped:
        serve(
            page.listen, page.port, lambda address: output.result(console=address), stopped.is_set
        )


@verb
def play(
    output: Output, scene: str = "balance", policy: Path | None = None, *, page: opt.Page
) -> None:
    """Balance the twin in the browser: push it, change the rig.

    SCENE is balance (default), why-it-falls, zero-error, friction or lqr.
    POLICY is one of yours, to choose on the page. Open the printed address.
    Everyone who has it plays with the same pendulum. It runs until Ctrl-C.
    Needs no robot and no recording.
    """
    from equipoise.console.play import SCENES, PlayPage
    from equipoise.console.web import serving

    if scene not in SCENES:
        raise InputError(f"there is no scene {scene!r}; choose one of {', '.join(SCENES)}")
    yours = None if policy is None else opt.Task().read(policy)
    with signals() as stopped, serving(page.listen, page.port) as (server, address):
        output.result(playground=address)
        PlayPage(server, SCENES[scene], yours).run(stopped.is_set)


@verb
def show(output: Output, run: Path, *, page: opt.Page) -> None:
    """Replay a run in the browser: the arm in 3-D, plots, events, until Ctrl-C.

    Open the printed address, token included. The page plays the run at 0.1 to 4
    times its speed, steps by a tick, and jumps to events. A truncated log is
    shown as far as it is readable.
    """
    from equipoise.console.replay import ReplayPage
    from equipoise.console.web import serving
    from equipoise.log.run_log import RunLog

    log = RunLog.load(run, damaged=True)
    with signals() as stopped, serving(page.listen, page.port) as (server, address):
        replay = ReplayPage(server, log, run.stem)
        output.result(run=run, replay=address, warnings=[log.damage])
        replay.play(stopped.is_set)
