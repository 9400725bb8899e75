"""`equipoise rig emulate`: emulates the hardware of a rig on this machine."""

import os
import select
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from math import remainder, tau
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.cli.verb import Options, verb

if TYPE_CHECKING:
    from equipoise.robots.emulation import Emulation

HOST = "127.0.0.1"
SHOWN = 0.02
"""Time between two states of the rig in a console [s]."""


class Emulated(Options):
    """The emulated rig."""

    world: str = "twin:nominal"
    """twin:nominal, twin:harsh, or twin:FILE."""
    arm: str = "iiwa7"
    """iiwa7, iiwa14, another registered arm, a URDF or a rig.toml."""
    pendulum: Path | None = None
    """Pendulum; by default the shipped one."""
    port: Annotated[int, Field(ge=0, lt=2**16)] = 30001
    """Port of the robot; 0 selects a free one."""
    encoder_link: Path | None = None
    """Further name of the encoder's terminal."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of all random numbers."""
    console: bool = False
    """Show the rig in the browser, with a button for each action."""


@verb
def emulate(output: Output, *, emulated: Emulated) -> None:
    """Emulate robot, pendulum and encoder, until Ctrl-C; type what the hand does.

    A KST server answers on a port of this machine, an encoder board on a
    pseudo-terminal. The arm begins beside its home. Type lift where a run asks
    for it, and release once it is armed.
    """
    from equipoise.model.worlds import pendulum_on, read_world
    from equipoise.rig import realtime
    from equipoise.rig.clocks import SystemClock
    from equipoise.robots.emulation import Emulation

    began = time.monotonic()

    def say(words: str) -> None:
        output.say(f"{time.monotonic() - began:8.1f} s  {words}")
        sys.stdout.flush()

    settings = read_world(emulated.world).settings
    emulation = Emulation(
        opt.read_arm(emulated.arm),
        pendulum_on(opt.read_pendulum(emulated.pendulum), settings),
        settings,
        SystemClock(),
        seed=emulated.seed,
        say=say,
    )
    link = emulated.encoder_link
    if link is not None:
        emulation.terminal.link(link)
    encoder = f"serial://{emulation.terminal.path if link is None else link.absolute()}"

    def ready(number: int) -> None:
        # The emulated cabinet takes the first core: the loop of the run stays on the last one.
        realtime.prepare(core=0)
        address = f"kst://{HOST}:{number}"
        then = f"deploy --robot {address} --encoder {encoder}"
        output.result(robot=address, encoder=encoder, actions=sorted(emulation.acts), then=then)
        sys.stdout.flush()

    with _shown(output, emulated.console, emulation) as show, signals() as stopped:

        def stop() -> bool:
            for word in _typed():
                if word in emulation.acts:
                    emulation.acts[word]()
                else:
                    output.warn(f"{word!r} is not one of {', '.join(emulation.acts)}")
            show()
            return stopped.is_set()

        emulation.run(HOST, emulated.port, stop, listening=ready)


@contextmanager
def _shown(output: Output, wanted: bool, emulation: "Emulation") -> "Generator[Callable[[], None]]":
    """Show the rig in a console, if wanted; yield a function to call each millisecond."""
    if not wanted:
        yield lambda: None
        return
    from equipoise.apps.console.publisher import publishing
    from equipoise.apps.console.server import console_process
    from equipoise.logs.shared import RunInfo

    bench, arm, due = emulation.bench, emulation.arm, 0.0
    info = RunInfo(
        title="emulated rig", pid=os.getpid(), arm=arm, actions=tuple(emulation.acts), stop="estop"
    )

    with publishing(info) as publisher, console_process() as address:

        def show() -> None:
            nonlocal due
            if bench.now < due:
                return
            due = bench.now + SHOWN
            publisher.show(bench.now, bench.q, remainder(bench.phi, tau))
            for word in publisher.words():
                output.say(f"console: {word}")
                publisher.say(bench.now, word)
                emulation.acts[word]()

        output.tell(f"  console  {address}")
        yield show


def _typed() -> list[str]:
    """Return the words that were typed since the last call."""
    if not select.select([sys.stdin], [], [], 0.0)[0]:
        return []
    return os.read(sys.stdin.fileno(), 1024).decode(errors="replace").split()
