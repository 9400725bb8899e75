"""What carries bytes: TCP, and a pipe in memory whose bytes take their time."""

import socket
from collections import deque
from typing import Final

from equipoise.devices.interfaces import Clock
from equipoise.errors import LinkError

CHUNK: Final = 65536
"""Bytes that are read at once."""


class MemoryPipe:
    """One end of a pipe in memory; `memory_pipe` makes both."""

    def __init__(self, clock: Clock, delay: float) -> None:
        """Make an end whose bytes arrive at the other one `delay` seconds after they were sent."""
        self._clock = clock
        self._coming: deque[tuple[float, bytes]] = deque()
        self._open = True
        self.other: MemoryPipe
        self.delay = delay
        """From here to the other end [s]; it may be changed at any time, the order stays."""
        self.cut = False
        """Whether bytes from here vanish, as on a line that nobody closed."""

    def write(self, data: bytes) -> None:
        """Send bytes to the other end."""
        if not (self._open and self.other._open):
            raise LinkError("the other end has closed the link; connect again")
        if data and not self.cut:
            arrival = self._clock.now() + self.delay
            if self.other._coming:
                arrival = max(arrival, self.other._coming[-1][0])
            self.other._coming.append((arrival, bytes(data)))

    def read(self) -> bytes:
        """Return what has arrived."""
        came = bytearray()
        while self._coming and self._coming[0][0] <= self._clock.now() + 1e-9:
            came += self._coming.popleft()[1]
        if not came and not self._coming and not self.other._open:
            raise LinkError("the other end has closed the link; connect again")
        return bytes(came)

    def close(self) -> None:
        """Close this end."""
        self._open = False


def memory_pipe(clock: Clock, delay: float = 0.0) -> tuple[MemoryPipe, MemoryPipe]:
    """Return the two ends of a pipe in memory.

    Args:
        clock: Whose time the bytes take.
        delay: How long they take, each way [s].
    """
    one, other = MemoryPipe(clock, delay), MemoryPipe(clock, delay)
    one.other, other.other = other, one
    return one, other


class TcpTransport:
    """A TCP connection without delays of its own."""

    def __init__(self, connection: socket.socket) -> None:
        """Take over a connected socket."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._quick = getattr(socket, "TCP_QUICKACK", None)

    def write(self, data: bytes) -> None:
        """Send bytes; a line that takes no more counts as down."""
        try:
            sent = self._socket.send(data)
        except OSError as error:
            raise LinkError(f"the link is down ({error}); connect again") from None
        if sent != len(data):
            raise LinkError("the link takes no more bytes; the other end does not read")

    def read(self) -> bytes:
        """Return what came."""
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkError(f"the link is down ({error}); connect again") from None
        if not data:
            raise LinkError("the other end has closed the link; connect again")
        if self._quick is not None:  # Linux forgets it with each segment
            self._socket.setsockopt(socket.IPPROTO_TCP, self._quick, 1)
        return data

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
