"""Verbs for a rig: `equipoise rig doctor`, `rig emulate` and `rig record`."""

import os
import select
import sys
import time
from contextlib import closing
from math import degrees
from pathlib import Path
from typing import Annotated

from pydantic import Field

import equipoise as eq
from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.errors import InputError
from equipoise.user_code import user_code


class Measurement(opt.Options):
    """Measurements."""

    seconds: Annotated[float, Field(ge=0.05, le=3600.0)] = 5.0
    """Duration of each measurement [s]."""


@opt.verb
def doctor(output: Output, *, rig: opt.Rig, measurement: Measurement) -> None:
    """Check whether machine and rig are fit for a run, and suggest fixes.

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
                "evidence": finding.evidence,
                "remedy": "" if finding.status == "good" else finding.remedy,
            }
            for finding in findings
        },
        restart=plugin and plugin.restart,
        code=int(not fit),
        then=opt.command("deploy", rig, dry_run=True) if fit and robot else "",
    )


class Emulated(opt.Options):
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
    """Additional path of the encoder's pseudo-terminal."""
    seed: opt.Seed = 0
    """Seed of all random numbers."""


@opt.verb
def emulate(output: Output, *, emulated: Emulated) -> None:
    """Emulate robot, pendulum and encoder, until Ctrl-C; type what the hand does.

    The robot answers at an address of this machine, an encoder board on a
    pseudo-terminal. The arm starts away from home. Type lift when a run asks
    for it, and release once it is armed.
    """
    from equipoise.model.pendulum import read_pendulum
    from equipoise.model.worlds import pendulum_on
    from equipoise.rig import host
    from equipoise.rig.clocks import SystemClock
    from equipoise.robots.emulation import Emulation

    began = time.monotonic()

    def say(words: str) -> None:
        output.tell(f"{time.monotonic() - began:8.1f} s  {words}")

    settings = eq.read_world(emulated.world).settings
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
    then = opt.command("deploy", "POLICY" if task else None, **links, **task)
    # The emulated robot takes the first core: the loop of the run stays on the last one. The
    # kernel's threads that carry its bytes get their turns there.
    host.prepare(core=0, priority=0)
    output.result(robot=links["robot"], encoder=encoder, actions=sorted(emulation.acts), then=then)

    with signals() as stopped:

        def stop() -> bool:
            if select.select([sys.stdin], [], [], 0.0)[0]:
                for word in os.read(sys.stdin.fileno(), 1024).decode(errors="replace").split():
                    emulation.acts.get(word, lambda word=word: say(f"unknown action {word!r}"))()
            return stopped.is_set()

        emulation.run(stop)


class Recording(opt.Options):
    """The recording."""

    encoder: str
    """Address of the encoder, e.g. serial:///dev/ttyACM0."""
    duration: Annotated[float, Field(ge=1.0, le=600.0)] = 30.0
    """Maximum duration from the release [s]."""
    counts_per_rev: int | None = None
    """Encoder counts per revolution, after x4."""


@opt.verb
def record(output: Output, *, recording: Recording, files: opt.Files) -> None:
    """Record a free swing of the pendulum from its encoder (swing.csv).

    Hold the pivot still. Let the pendulum hang, lift it, hold it, release it.
    The angle is shown meanwhile. Ctrl-C ends the recording without a file.
    """
    from equipoise.rig.clocks import SystemClock
    from equipoise.rig.connection import open_encoder
    from equipoise.robots.encoder.swing import record_swing

    clock = SystemClock()
    sensor = open_encoder(recording.encoder, clock, counts_per_rev=recording.counts_per_rev)
    out = files.file(output, "swing.csv")
    driver = user_code(f"the driver of {recording.encoder}")
    with output.busy("connecting") as rename, driver, closing(sensor):
        sensor.connect()
        swing, missing = record_swing(
            sensor,
            clock,
            recording.duration,
            tell=lambda instruction: output.tell(f"  {instruction}"),
            show=lambda theta: rename(f"{degrees(theta):+7.1f} deg"),
        )
    eq.write_swing(out, swing)
    output.result(
        samples=len(swing.time),
        duration_s=float(swing.time[-1]),
        missing=missing,
        rejected=sensor.rejected,
        counts_per_rev=sensor.counts_per_rev,
        recording=out,
        then=opt.command("identify", out),
    )
