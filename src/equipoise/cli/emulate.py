"""`equipoise rig emulate`: the rig's hardware on this machine, for a driver that cannot tell."""

import queue
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli.options import ArmName, Json, Seed, read_arm, read_pendulum
from equipoise.cli.output import Output, stop_by_signal, verb
from equipoise.devices import realtime

if TYPE_CHECKING:
    from equipoise.devices.emulation import Emulation
    from equipoise.model.pendulum import Pendulum, PendulumParameters
    from equipoise.model.sim_configs import TwinSettings

HOST = "127.0.0.1"


@verb
def emulate(
    world: Annotated[
        str,
        typer.Option(metavar="WORLD", help="twin:nominal, twin:harsh or twin:FILE."),
    ] = "twin:nominal",
    robot: Annotated[
        str,
        typer.Option(metavar="SCHEME", help="Robot to emulate, by the scheme of its addresses."),
    ] = "kst",
    arm: ArmName = "iiwa7",
    pendulum: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="From equipoise identify; by default the shipped one."),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, metavar="N", help="Of the robot; 0 for any free one.")
    ] = 30001,
    encoder_link: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Make this a link to the encoder's terminal."),
    ] = None,
    no_operator: Annotated[
        bool,
        typer.Option(
            "--no-operator", help="Type what to do; else an operator acts on what is seen."
        ),
    ] = False,
    clumsy: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, metavar="P", help="Chance that the hand pushes or drags."),
    ] = 0.0,
    inject: Annotated[
        str | None,
        typer.Option(
            metavar="FAULTS",
            help="Faults of the robot's answers; kst: delay=S,jitter=S,drop=SHARE,refuse=SHARE.",
        ),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Emulate robot, pendulum, encoder and operator, until Ctrl-C.

    The robot answers on a port of this machine, an encoder board on a
    pseudo-terminal. The arm begins beside its home. The operator cannot see
    your screen: the button is pressed when the arm rests at home and the
    pendulum hangs, the pendulum lifted some time after the arm has moved there.
    """
    output = Output(as_json)
    output.say(f"Emulating the {arm}, world {world}")
    sys.stdout.flush()
    emulation, friction = _emulation(
        world,
        arm,
        pendulum,
        not no_operator,
        clumsy,
        robot,
        inject,
        encoder_link,
        seed,
        _speaker(output),
    )
    terminal = emulation.terminal if encoder_link is None else encoder_link.absolute()
    encoder = f"serial://{terminal}"

    def ready(number: int) -> None:
        # A cabinet is a machine of its own: nothing here may hold it up, least of all the run's
        # loop, which stays on the last core.
        realtime.prepare(core=0)
        address = f"{robot}://{HOST}:{number}"
        output.rows({"robot": address, "encoder": encoder, "pendulum": friction})
        if no_operator:
            output.say(f"type what to do: {', '.join(emulation.acts)}")
        output.next("deploy", "--robot", address, "--encoder", encoder)
        output.result({"robot": address, "encoder": encoder})
        sys.stdout.flush()

    words = _typed() if no_operator else None
    with stop_by_signal() as stopped:

        def stop() -> bool:
            if words is not None and not words.empty():
                _act(output, emulation, words.get())
            return stopped()

        emulation.run(HOST, port, stop, listening=ready)
    output.rows({"stalls of this host": str(emulation.stalls)})


def _emulation(
    world: str,
    arm: str,
    pendulum: Path | None,
    operator: bool,
    clumsy: float,
    robot: str,
    inject: str | None,
    link: Path | None,
    seed: int,
    say: Callable[[str], None],
) -> "tuple[Emulation, str]":
    """Return what is emulated, and the friction of its pendulum in words."""
    from equipoise.devices.clocks import SystemClock
    from equipoise.devices.emulation import Emulation
    from equipoise.model.sim_configs import pivot_friction, read_world

    name, settings = read_world(world)
    identified = read_pendulum(pendulum)
    emulation = Emulation(
        read_arm(arm),
        _as_it_is(identified, settings, seed),
        settings,
        SystemClock(),
        operator=operator,
        clumsy=clumsy,
        robot=robot,
        faults=inject or "",
        link=link,
        seed=seed,
        say=say,
    )
    return emulation, pivot_friction(identified, settings).words(name)


def _as_it_is(pendulum: "Pendulum", settings: "TwinSettings", seed: int) -> "PendulumParameters":
    """Return the pendulum as it differs from what was identified, by the world's numbers."""
    import numpy as np

    from equipoise.learning.closed_loop import scaled
    from equipoise.model.sim_configs import pivot_friction

    inertia, friction = np.random.default_rng([seed, 2]).standard_normal(2).tolist()
    own = scaled(
        pendulum.parameters(),
        1.0 + settings.inertia_sigma * inertia,
        1.0 + settings.friction_sigma * friction,
    )
    return pivot_friction(pendulum, settings).on(own)


def _speaker(output: Output) -> Callable[[str], None]:
    import time

    began = time.monotonic()

    def say(words: str) -> None:
        output.say(f"{time.monotonic() - began:8.1f} s  {words}")
        sys.stdout.flush()

    return say


def _act(output: Output, emulation: "Emulation", line: str) -> None:
    act = emulation.acts.get(line.strip())
    if act is not None:
        act()
    elif line.strip():
        output.warn(f"{line.strip()!r} is none of {', '.join(emulation.acts)}")


def _typed() -> "queue.SimpleQueue[str]":
    """Return where the lines arrive that are typed from now on."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)

    threading.Thread(target=read, daemon=True).start()
    return lines
