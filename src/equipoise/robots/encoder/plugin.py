"""Plugin of encoder boards that send E-lines, on serial ports of this machine.

Addresses are `serial:///dev/ttyACM0` or `serial://COM3`. Reads and writes do not block.
"""

from collections.abc import Generator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Final

from serial import Serial

from equipoise.errors import InputError, LinkError
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import Emulated, SensorPlugin, Session
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder

BAUD: Final = 500_000
"""Baud rate of a serial line [baud], equal to the firmware's. 1000 lines of 36 bytes per second
fill 72 % of it, and an AVR at 16 MHz hits it exactly. USB boards ignore it."""


class SerialTransport:
    """Open serial port."""

    def __init__(self, port: Serial, name: str) -> None:
        """Take over an open port.

        Args:
            port: Port with zero timeouts, so that it does not block.
            name: Name in messages.
        """
        self._port, self._name = port, name

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            LinkError: The device is gone, or accepts no more bytes.
        """
        with self._link_errors():
            self._port.write(data)

    def read(self) -> bytes:
        """Return the received bytes.

        Raises:
            LinkError: The device is gone.
        """
        # Linux lets a read of an empty port wait for the worker that delivers the next bytes.
        with self._link_errors():
            return self._port.read(waiting) if (waiting := self._port.in_waiting) else b""

    def close(self) -> None:
        """Close the port."""
        with suppress(OSError):
            self._port.close()

    @contextmanager
    def _link_errors(self) -> Generator[None]:
        try:
            yield
        except (OSError, TypeError) as error:  # pyserial's TypeError: the port was closed meanwhile
            message = f"{self._name} is gone ({error}); check its cable, then connect again"
            raise LinkError(message) from None


def open_serial(name: str) -> SerialTransport:
    """Open the serial port of a device exclusively.

    Raises:
        LinkError: The port cannot be opened.
    """
    try:
        port = Serial(name, BAUD, timeout=0.0, write_timeout=0.0, exclusive=True)
    except (OSError, ValueError) as error:
        raise LinkError(
            f"cannot open {name} ({error}); find the board with `python -m serial.tools."
            "list_ports`, close other programs that use it, and join the group dialout"
        ) from None
    # FTDI's USB adapters hold bytes for 16 ms otherwise. Pseudo-terminals do not support the mode.
    with suppress(AttributeError, NotImplementedError, OSError, ValueError):
        port.set_low_latency_mode(True)
    return SerialTransport(port, name)


def open_sensor(
    address: str, session: Session, counts_per_rev: int | None, sign: int
) -> LineEncoder:
    """Return the driver for an address; nothing is opened before it is connected.

    Raises:
        InputError: The address is invalid.
    """
    scheme, _, name = address.partition("://")
    if scheme != "serial" or not name or "?" in name or ("/" in name and not name.startswith("/")):
        form = "serial:///dev/ttyACM0"
        raise InputError(f"{address!r} is no address of a serial port; expected {form}")
    opened, clock = partial(open_serial, name), session.clock
    return LineEncoder(opened, clock, counts_per_rev=counts_per_rev, sign=sign, name=address)


def emulate(rig: SimulatedRig, clock: Clock, counts_per_rev: int, sign: int) -> Emulated:
    """Return the driver in front of an emulated board on a simulated spindle."""
    board = Board(lambda: rig.theta, counts_per_rev=counts_per_rev, sign=sign)
    reader, wire = memory_pipe(clock, rig.settings.encoder_age)

    def advance(now: float) -> None:
        board.press(rig.button)
        sent = board.advance(now)
        with suppress(LinkError):
            board.feed(wire.read())
            wire.write(sent)

    sensor = LineEncoder(lambda: reader, clock, counts_per_rev=counts_per_rev, sign=sign)
    return Emulated(sensor, advance, board, wire)


PLUGIN: Final = SensorPlugin(open=open_sensor, emulate=emulate)
"""Registered as `serial`."""
