"""Verbs for a rig: `equipoise rig doctor` and `rig emulate`."""

import os
import select
import sys
import time
from pathlib import Path
from typing import Annotated

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.options import Options, command, verb
from equipoise.cli.output import Output, signals
from equipoise.errors import InputError


class Measurement(Options):
    """Measurements."""

    seconds: Annotated[float, Field(ge=0.05, le=3600.0)] = 5.0
    """Duration of each measurement [s]."""


@verb
def doctor(output: Output, *, rig: opt.Rig, measurement: Measurement) -> None:
    """Check whether machine and rig are fit for a run, and advise a fix.

    Nothing moves; the robot's answers are timed at rest. Exit code 1: not fit.
    """
    from equipoise.rig.checks import examine
    from equipoise.rig.clocks import SystemClock
    from equipoise.rig.config import read_rig, world_of
    from equipoise.rig.connection import open_encoder
    from equipoise.rig.plugins import Session, robot_plugin

    robot, encoder = rig.robot, rig.encoder
    if robot is not None and world_of(robot):
        raise InputError(f"{robot} has no link to time; give the address of a real robot")
    clock, plugin, device = SystemClock(), None, None
    if robot is not None:
        plugin = robot_plugin(robot)
        device = plugin.open(robot, Session(clock, clock, notify=output.tell))
    with output.busy("measuring"):
        findings = examine(
            device,
            None if encoder is None else open_encoder(encoder, clock),
            None if rig.rig is None else read_rig(rig.rig),
            measurement.seconds,
            paced=plugin is not None and plugin.paced,
        )
    fit = all(finding.status != "bad" for finding in findings)
    output.result(
        verdict="fit" if fit else "not fit",
        findings={
            finding.name: {
                "status": finding.status,
                "found": finding.evidence,
                "remedy": finding.remedy,
            }
            for finding in findings
        },
        restart=plugin and plugin.restart,
        code=int(not fit),
        then=command("deploy", rig, dry_run=True) if fit and robot else "",
    )


class Emulated(Options):
    """The emulated rig."""

    robot: str = "kst"
    """kst, or another robot whose package emulates its hardware."""
    world: str = "twin:nominal"
    """twin:NAME ({worlds}), or twin:FILE."""
    arm: str = "iiwa7"
    """{arms}, a URDF or a rig.toml."""
    pendulum: Path | None = None
    """Pendulum; by default the shipped one."""
    port: opt.Port | None = None
    """Port of a KST server (default: 30001); 0 selects a free one."""
    encoder_link: Path | None = None
    """Further name of the encoder's terminal."""
    seed: opt.Seed = 0
    """Seed of all random numbers."""


@verb
def emulate(output: Output, *, emulated: Emulated) -> None:
    """Emulate robot, pendulum and encoder, until Ctrl-C; type what the hand does.

    The robot answers at an address of this machine, an encoder board on a
    pseudo-terminal. The arm begins beside its home. Type lift where a run asks
    for it, and release once it is armed.
    """
    from equipoise.model.pendulum import read_pendulum
    from equipoise.model.worlds import pendulum_on, read_world
    from equipoise.rig import host
    from equipoise.rig.clocks import SystemClock
    from equipoise.robots.emulation import Emulation

    began = time.monotonic()

    def say(words: str) -> None:
        output.tell(f"{time.monotonic() - began:8.1f} s  {words}")
        output.stream.flush()

    settings = read_world(emulated.world).settings
    link = emulated.encoder_link
    emulation = Emulation(
        emulated.robot,
        opt.read_arm(emulated.arm),
        pendulum_on(read_pendulum(emulated.pendulum), settings),
        settings,
        SystemClock(),
        port=emulated.port,
        seed=emulated.seed,
        link=link,
        say=say,
    )
    encoder = f"serial://{(link or emulation.terminal.path).absolute()}"

    task = emulated.model_dump(include={"arm", "pendulum"}, exclude_defaults=True)
    links = {"robot": emulation.hardware.address, "encoder": encoder}
    # The shipped table is for the defaults.
    then = command("deploy", "POLICY" if task else None, **links, **task)
    # The emulated robot takes the first core: the loop of the run stays on the last one. The
    # kernel's threads that carry its bytes get their turns there.
    host.prepare(core=0, priority=0)
    output.result(robot=links["robot"], encoder=encoder, actions=sorted(emulation.acts), then=then)
    output.stream.flush()

    with signals() as stopped:

        def stop() -> bool:
            if select.select([sys.stdin], [], [], 0.0)[0]:
                for word in os.read(sys.stdin.fileno(), 1024).decode(errors="replace").split():
                    emulation.acts.get(word, lambda word=word: say(f"unknown action {word!r}"))()
            return stopped.is_set()

        emulation.run(stop)
