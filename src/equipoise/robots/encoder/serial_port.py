"""Serial ports of this machine and on the network, as a `Transport`.

`serial:///dev/ttyACM0` is a device, `serial://COM3` a device on Windows; `?baud=115200` sets the
baud rate, which USB boards ignore. `socket://host:port` is a port on the network. Reads and writes
do not block.
"""

import errno
from contextlib import suppress
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qs, urlsplit

from equipoise.errors import InputError, LinkError

if TYPE_CHECKING:
    from serial import SerialBase

BAUD: Final = 500_000
"""Baud rate of a serial line [baud], equal to the firmware's. 1000 lines of 36 bytes per second
fill 72 % of it, and an AVR at 16 MHz hits it exactly."""
FORMS: Final = "serial:///dev/ttyACM0 or socket://host:port"
CHUNK: Final = 4096
"""Maximum number of bytes per read: the buffer of a Linux terminal."""


class SerialTransport:
    """Open serial port."""

    def __init__(self, port: "SerialBase", name: str) -> None:
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
        # pyserial raises a TypeError for a port that was closed meanwhile.
        try:
            self._port.write(data)
        except (OSError, TypeError) as error:
            raise self._gone(error) from None

    def read(self) -> bytes:
        """Return the received bytes.

        Raises:
            LinkError: The device is gone.
        """
        try:
            return self._port.read(CHUNK)
        except (OSError, TypeError) as error:
            raise self._gone(error) from None

    def close(self) -> None:
        """Close the port."""
        with suppress(OSError):
            self._port.close()

    def _gone(self, error: Exception) -> LinkError:
        return LinkError(f"{self._name} is gone ({error}); check its cable, then connect again")


def device_of(uri: str) -> tuple[str, int] | None:
    """Return name and baud rate of the device at an address; None for a port on the network.

    Raises:
        InputError: The address is invalid.
    """
    try:
        parts = urlsplit(uri)
        if parts.scheme == "socket" and parts.hostname and parts.port and parts.path in ("", "/"):
            return None
    except ValueError:  # the port is not a number, or a bracket is open
        parts = urlsplit("")
    name = parts.path if not parts.netloc else parts.netloc
    if parts.scheme != "serial" or not name or (parts.netloc and parts.path.strip("/")):
        raise InputError(f"{uri!r} is no address of a serial port; expected {FORMS}")
    options = parse_qs(parts.query, keep_blank_values=True)
    baud = options.pop("baud", [str(BAUD)])[-1]
    if options or not baud.isdecimal() or not 0 < int(baud) <= 10**7:
        raise InputError(f"{uri!r} has options that are unknown; expected at most ?baud={BAUD}")
    return name, int(baud)


def open_serial(uri: str) -> SerialTransport:
    """Open a serial port exclusively.

    Args:
        uri: `serial:///dev/ttyACM0`, `serial://COM3`, with `?baud=N` if it is not `BAUD`; or
            `socket://host:port`.

    Raises:
        InputError: The address is invalid.
        LinkError: The port cannot be opened; the message names cause and cure.
    """
    device = device_of(uri)
    if device is None:
        return SerialTransport(_open_socket(uri), uri)
    return SerialTransport(_open_device(*device), device[0])


def _open_device(name: str, baud: int) -> "SerialBase":
    from serial import Serial

    try:
        port = Serial(name, baud, timeout=0.0, write_timeout=0.0, exclusive=True)
    except (OSError, ValueError) as error:
        raise LinkError(_why(name, getattr(error, "errno", None), error)) from None
    # FTDI's USB adapters hold bytes for 16 ms otherwise. Pseudo-terminals do not support the mode.
    with suppress(AttributeError, NotImplementedError, OSError, ValueError):
        port.set_low_latency_mode(True)
    return port


def _open_socket(uri: str) -> "SerialBase":
    from serial import serial_for_url

    try:
        return serial_for_url(uri, timeout=0.0)
    except (OSError, ValueError) as error:
        raise LinkError(
            f"cannot connect to {uri} ({error}); check host and port, and that the other end serves"
        ) from None


def _why(name: str, number: int | None, error: Exception) -> str:
    if number == errno.ENOENT:
        return (
            f"there is no device {name}; plug the board in, and find its name with: "
            "python -m serial.tools.list_ports"
        )
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{name} may not be opened by this user; join its group, then log in again: "
            "sudo usermod -aG dialout $USER"
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{name} is in use; close the serial monitor or the other program that has it"
    return f"cannot open {name} ({error}); check that it is a serial port and no one else has it"
