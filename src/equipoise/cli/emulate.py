"""`equipoise rig emulate`: emulates the hardware of a rig on this machine."""

import os
import queue
import sys
import threading
import time
from contextlib import contextmanager
from math import remainder, tau
from pathlib import Path
from typing import TYPE_CHECKING

from equipoise.cli import options as opt
from equipoise.cli.console import show_address
from equipoise.cli.output import Output, stop_by_signal, verb
from equipoise.rig import realtime
from equipoise.user_code import guest_code

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from equipoise.model.pendulum import Pendulum, PendulumParameters
    from equipoise.model.worlds import TwinSettings
    from equipoise.robots.emulation import Emulation

HOST = "127.0.0.1"
SHOWN = 0.02
"""Time between two states of the rig in a console [s]."""


@verb
def emulate(
    world: str = opt.TWIN,
    robot: str = opt.value(
        "SCHEME", "Robot to emulate, by the scheme of its addresses.", default="kst"
    ),
    arm: str = opt.ARM,
    pendulum: Path | None = opt.value(
        "FILE", "From equipoise identify; by default the shipped one."
    ),
    port: int = opt.value(
        "N", "Port of the robot; 0 selects a free one.", min=0, max=65535, default=30001
    ),
    encoder_link: Path | None = opt.value("PATH", "Further name of the encoder's terminal."),
    no_operator: bool = opt.flag("--no-operator", "Read the operator's actions from the keyboard."),
    clumsy: float = opt.value(
        "P", "Probability that the hand pushes or drags.", min=0.0, max=1.0, default=0.0
    ),
    inject: str = opt.value(
        "FAULTS",
        "Faults of the robot's answers; kst: delay=S,jitter=S,drop=SHARE,refuse=SHARE.",
        show_default=False,
        default="",
    ),
    seed: int = opt.SEED,
    console: bool = opt.flag(
        "--console", "Show the rig in the browser, with a button for each action."
    ),
    as_json: bool = opt.JSON,
) -> None:
    """Emulate robot, pendulum, encoder and operator, until Ctrl-C.

    The robot answers on a port of this machine, an encoder board on a
    pseudo-terminal. The arm begins beside its home. The operator does not see
    your screen: the operator presses the button when the arm rests at home and
    the pendulum hangs, and lifts the pendulum after the arm has moved there.
    """
    output = Output(as_json)
    output.say(f"Emulating the {arm}, world {world}")
    sys.stdout.flush()

    from equipoise.model.worlds import pivot_friction, read_world
    from equipoise.rig.clocks import SystemClock
    from equipoise.robots.emulation import Emulation

    began = time.monotonic()

    def say(words: str) -> None:
        output.say(f"{time.monotonic() - began:8.1f} s  {words}")
        sys.stdout.flush()

    name, settings = read_world(world)
    identified = opt.read_pendulum(pendulum)
    emulation = Emulation(
        opt.read_arm(arm),
        _true_pendulum(identified, settings, seed),
        settings,
        SystemClock(),
        clumsy=None if no_operator else clumsy,
        robot=robot,
        faults=inject,
        seed=seed,
        say=say,
    )
    if encoder_link is not None:
        emulation.terminal.link(encoder_link)
    encoder = f"serial://{encoder_link or emulation.terminal.path}"
    friction = pivot_friction(identified, settings)

    def ready(number: int) -> None:
        # The emulated cabinet takes the first core: the loop of the run stays on the last one.
        realtime.prepare(core=0)
        address = f"{robot}://{HOST}:{number}"
        output.rows({"robot": address, "encoder": encoder, "pendulum": friction.describe(name)})
        if no_operator:
            output.say(f"type an action: {', '.join(emulation.acts)}")
        output.next("deploy", "--robot", address, "--encoder", encoder)
        output.result(robot=address, encoder=encoder)
        sys.stdout.flush()

    words = _typed() if no_operator else None
    with _shown(output, console, emulation) as show, stop_by_signal() as stopped:

        def stop() -> bool:
            word = "" if words is None or words.empty() else words.get().strip()
            if word in emulation.acts:
                emulation.acts[word]()
            elif word:
                output.warn(f"{word!r} is not an action; type one of {', '.join(emulation.acts)}")
            show()
            return stopped()

        with guest_code(f"the emulator of {robot}"):
            emulation.run(HOST, port, stop, listening=ready)
    output.rows({"stalls of this host": str(emulation.stalls)})


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

        show_address(output, address)
        yield show


def _true_pendulum(
    pendulum: "Pendulum", settings: "TwinSettings", seed: int
) -> "PendulumParameters":
    """Return the emulated pendulum: the identified one, varied as the world's numbers say."""
    import numpy as np

    from equipoise.model.worlds import pivot_friction
    from equipoise.worlds.plant import scaled

    inertia, friction = np.random.default_rng([seed, 2]).standard_normal(2).tolist()
    own = scaled(
        pendulum.parameters(),
        1.0 + settings.inertia_sigma * inertia,
        1.0 + settings.friction_sigma * friction,
    )
    return pivot_friction(pendulum, settings).on(own)


def _typed() -> "queue.SimpleQueue[str]":
    """Return a queue of the lines that are typed from now on."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)

    threading.Thread(target=read, daemon=True).start()
    return lines
