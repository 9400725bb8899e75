"""`equipoise play`: opens a playground in the browser."""

from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.cli.verb import Options, verb
from equipoise.errors import InputError


class Yours(Options):
    """Policies."""

    policy: Path | None = None
    """A policy of yours, to choose on the page."""


@verb
def play(output: Output, scene: str = "balance", *, yours: Yours, page: opt.Page) -> None:
    """Balance the twin in the browser: push it, change the rig.

    SCENE is balance (default), why-it-falls, zero-error, friction or lqr. Open
    the printed address. Everyone who has it plays with the same pendulum. It
    runs until Ctrl-C. Needs no robot and no recording.
    """
    from equipoise.apps.console.play import play
    from equipoise.apps.console.playground import SCENES

    if scene not in SCENES:
        raise InputError(f"there is no scene {scene!r}; choose one of {', '.join(SCENES)}")
    policy = None if yours.policy is None else opt.Task().read(yours.policy)

    def ready(address: str) -> None:
        output.result(playground=address)

    with signals() as stopped:
        play(
            SCENES[scene], ready, stopped.is_set, yours=policy, address=page.listen, port=page.port
        )
