"""`equipoise play`: opens a playground in the browser."""

import sys
from pathlib import Path

from equipoise.cli import options as opt
from equipoise.cli.output import Output, stop_by_signal, verb


@verb
def play(
    scene: str = opt.argument(
        "SCENE",
        "Scene to begin with: balance, why-it-falls, paper, zero-error, friction or lqr.",
        "balance",
    ),
    policy: Path | None = opt.value("POLICY", "A policy of yours, to choose on the page."),
    listen: str = opt.value(
        "ADDRESS",
        "Listen on this address of the computer, for browsers on others; by default only browsers "
        "on this computer reach the page.",
        default="127.0.0.1",
    ),
    port: int = opt.value(
        "N", "Port of the page; 0 selects a free one.", min=0, max=65535, default=0
    ),
    as_json: bool = opt.JSON,
) -> None:
    """Balance the twin in the browser: push it, change the rig, train a table.

    Open the printed address. Everyone who has it plays with the same pendulum.
    It runs until Ctrl-C. Needs no robot and no recording.
    """
    output = Output(as_json)
    output.say("Playground")

    from equipoise.apps.console.play import play
    from equipoise.apps.console.scenes import scene_named

    begin = scene_named(scene)
    yours = None if policy is None else opt.read_policy(policy)

    def ready(address: str) -> None:
        output.rows({"playground": address})
        output.result(playground=address)
        sys.stdout.flush()

    with stop_by_signal() as stopped:
        play(begin, ready, stopped, yours=yours, address=listen, port=port)
