"""Plugin of encoder boards that send E-lines: `serial:///dev/ttyACM0`."""

from contextlib import suppress
from functools import partial
from typing import Any, Final

from equipoise.errors import LinkError
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import Emulated, SensorPlugin, Session
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder
from equipoise.robots.encoder.serial_port import device_of, open_serial


def open_sensor(
    address: str, session: Session, counts_per_rev: int | None, sign: int
) -> LineEncoder:
    """Return the driver for an address; nothing is opened before it is connected."""
    device_of(address)
    opened, clock = partial(open_serial, address), session.clock
    return LineEncoder(opened, clock, counts_per_rev=counts_per_rev, sign=sign, name=address)


def emulate(
    rig: SimulatedRig, clock: Clock, counts_per_rev: int, sign: int, seed: int
) -> Emulated[Any]:
    """Return the driver in front of an emulated board on a simulated spindle."""
    counts = rig.settings.counts_per_rev
    board = Board(lambda: rig.theta, counts_per_rev=counts, sign=sign, seed=seed)
    reader, wire = memory_pipe(clock, rig.settings.encoder_age)

    def advance(now: float) -> None:
        board.press(rig.button)
        sent = board.advance(now)
        with suppress(LinkError):
            board.feed(wire.read())
            wire.write(sent)

    driver = partial(LineEncoder, counts_per_rev=counts_per_rev, sign=sign)
    return Emulated(driver(lambda: reader, clock), advance, board, wire, driver)


PLUGIN: Final = SensorPlugin(open=open_sensor, emulate=emulate)
"""Registered as `serial`."""
