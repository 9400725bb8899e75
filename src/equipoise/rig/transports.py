"""Transports of bytes: sockets, and a pipe in memory with a delay."""

import socket
from collections import deque
from typing import Final

from equipoise.errors import LinkError
from equipoise.rig.interfaces import Clock

CHUNK: Final = 65536
"""Maximum number of bytes per read."""


class MemoryPipe:
    """One end of a pipe in memory; `memory_pipe` makes both."""

    def __init__(self, clock: Clock, delay: float) -> None:
        """Create an end whose bytes arrive at the other one after a delay [s]."""
        self._clock = clock
        self._coming: deque[tuple[float, bytes]] = deque()
        self._open = True
        self.other: MemoryPipe
        self.delay = delay
        """Delay to the other end [s]; may be changed at any time, bytes keep their order."""
        self.cut = False
        """Whether sent bytes are lost, as on a half-open link."""

    def write(self, data: bytes) -> None:
        """Send bytes to the other end."""
        if not (self._open and self.other._open):
            raise LinkError("the other end has closed the link")
        if data and not self.cut:
            arrival = self._clock.now() + self.delay
            if self.other._coming:
                arrival = max(arrival, self.other._coming[-1][0])
            self.other._coming.append((arrival, bytes(data)))

    def read(self) -> bytes:
        """Return the received bytes."""
        received = bytearray()
        while self._coming and self._coming[0][0] <= self._clock.now() + 1e-9:
            received += self._coming.popleft()[1]
        if not received and not self._coming and not self.other._open:
            raise LinkError("the other end has closed the link")
        return bytes(received)

    def close(self) -> None:
        """Close this end."""
        self._open = False


def memory_pipe(clock: Clock, delay: float = 0.0) -> tuple[MemoryPipe, MemoryPipe]:
    """Return the two ends of a pipe in memory.

    Args:
        clock: Clock of the delay.
        delay: Delay each way [s].
    """
    first, second = MemoryPipe(clock, delay), MemoryPipe(clock, delay)
    first.other, second.other = second, first
    return first, second


class SocketTransport:
    """Connected TCP socket, without Nagle's algorithm and delayed acknowledgements."""

    def __init__(self, connection: socket.socket) -> None:
        """Wrap a connected socket."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._quick = getattr(socket, "TCP_QUICKACK", None)

    def write(self, data: bytes) -> None:
        """Send bytes; a full send buffer is an error of the link."""
        try:
            sent = self._socket.send(data)
        except OSError as error:
            raise LinkError(f"the link is down ({error})") from None
        if sent != len(data):
            raise LinkError("the link takes no more bytes; the other end does not read")

    def read(self) -> bytes:
        """Return the received bytes."""
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkError(f"the link is down ({error})") from None
        if not data:
            raise LinkError("the other end has closed the link")
        if self._quick is not None:  # Linux resets the option with each segment
            self._socket.setsockopt(socket.IPPROTO_TCP, self._quick, 1)
        return data

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
