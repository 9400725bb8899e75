"""Serial ports of this machine and on the network, as a `Transport`.

`serial:///dev/ttyACM0` is a device, `serial://COM3` a device on Windows, `socket://host:port` a
port on the network. Reads and writes do not block.
"""

from contextlib import suppress
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from equipoise.errors import InputError, LinkError

if TYPE_CHECKING:
    from serial import SerialBase

BAUD: Final = 500_000
"""Baud rate of a serial line [baud], equal to the firmware's. 1000 lines of 36 bytes per second
fill 72 % of it, and an AVR at 16 MHz hits it exactly. USB boards ignore it."""
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


def device_of(uri: str) -> str:
    """Return the name of the device at an address; the address itself for a port on the network.

    Raises:
        InputError: The address is invalid.
    """
    with suppress(ValueError):  # the port is not a number, or a bracket is open
        parts = urlsplit(uri)
        if parts.scheme == "socket" and parts.hostname and parts.port and parts.path in ("", "/"):
            return uri
        name = parts.netloc or parts.path
        alone = not (parts.netloc and parts.path.strip("/")) and not parts.query
        if parts.scheme == "serial" and name and alone:
            return name
    raise InputError(
        f"{uri!r} is no address of a serial port; expected serial:///dev/ttyACM0 or "
        "socket://host:port"
    )


def open_serial(uri: str) -> SerialTransport:
    """Open a serial port exclusively.

    Args:
        uri: `serial:///dev/ttyACM0`, `serial://COM3` or `socket://host:port`.

    Raises:
        InputError: The address is invalid.
        LinkError: The port cannot be opened.
    """
    from serial import Serial, serial_for_url

    name = device_of(uri)
    try:
        if name == uri:
            return SerialTransport(serial_for_url(uri, timeout=0.0), uri)
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
