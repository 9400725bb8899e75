"""Guard of a velocity servo: it stops the arm when its client stops talking.

The velocity servo of a KST server integrates the last velocity for ever. A guard stands between the
driver and the server, in a process of its own, and passes all bytes on. If the driver closes the
link, or is silent for `MAX_SILENCE` while the arm has a velocity, the guard slows the arm down,
stops the servo, and ends the server.

It helps against a driver that dies or hangs. Against a computer or a cable that fails nothing helps
but the E-stop: the server then moves the arm on until the cabinet stops it at a limit.

`VelocityGuard` knows neither sockets nor a clock; `python -m equipoise.devices.kuka.velocity_guard`
is the process, which `guarded` starts.
"""

import argparse
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from typing import Final

from equipoise.devices.kuka import codec
from equipoise.devices.transports import CHUNK, SocketTransport
from equipoise.errors import LinkError

MAX_SILENCE: Final = 0.020
"""Longest silence of the driver while the arm has a velocity [s]: four setpoints. At 0.5 rad/s a
joint moves by 0.01 rad meanwhile."""
PERIOD: Final = 0.005
"""Time between two velocities of the guard [s]."""
DECELERATION: Final = 5.0
"""Deceleration of the fastest joint when the guard acts [rad/s^2]: half of what a joint can."""


class VelocityGuard:
    """Bytes and times of a guard; after it has acted, the driver's link is closed."""

    def __init__(self) -> None:
        """Begin with an arm at rest."""
        self._lines = codec.KstLineSplitter()
        self._velocity = (0.0,)
        self._heard = 0.0
        self._acted: float | None = None
        self._sent, self._steps = 0, 0
        self.done = False
        """Whether the servo has been stopped and the server ended."""

    @property
    def acts(self) -> bool:
        """Whether the guard has taken over from the driver."""
        return self._acted is not None

    def hear(self, data: bytes, now: float) -> bytes:
        """Return the driver's bytes for the server; none once the guard acts.

        Args:
            data: Bytes of the driver; none are silence.
            now: The time [s].
        """
        if self.acts or not data:
            return b""
        self._heard = now
        try:
            for line in self._lines.feed(data):
                self._read(line)
        except LinkError:  # no client of this project sends such lines
            self.act(now)
            return b""
        return data

    def act(self, now: float) -> None:
        """Take over from the driver: slow the arm down, stop the servo, end the server."""
        if self.acts:
            return
        self._acted = now
        self._steps = int(max(map(abs, self._velocity)) / (DECELERATION * PERIOD)) + 1

    def due(self, now: float) -> bytes:
        """Return the guard's own bytes for the server, due by now.

        Args:
            now: The time [s].
        """
        if not self.acts and any(self._velocity) and now - self._heard > MAX_SILENCE:
            self.act(now)
        if self._acted is None or self.done:
            return b""
        due = min(int((now - self._acted) / PERIOD) + 1, self._steps)
        lines = b""
        while self._sent < due:
            self._sent += 1
            share = 1.0 - self._sent / self._steps
            slowed = [share * v for v in self._velocity]
            lines += codec.velocity(slowed, "done", joints=len(slowed))
        if self._sent == self._steps:
            self.done = True
            lines += codec.STOP_SERVO + codec.END
        return lines

    def _read(self, line: bytes) -> None:
        command, *fields = codec.tokens(line)
        if command in codec.VELOCITIES.values() and fields:
            self._velocity = tuple(map(codec.java_double, fields))
        elif line + b"\n" in (codec.STOP_SERVO, codec.END):
            self._velocity = (0.0,) * len(self._velocity)


def guarded(connection: socket.socket) -> SocketTransport:
    """Start the guard's process on a connection to the server; return the driver's end.

    Args:
        connection: Connected to the server; it belongs to the guard from now on.
    """
    own, other = socket.socketpair()
    with connection, other:
        files = connection.fileno(), other.fileno()
        subprocess.Popen(
            [sys.executable, "-m", "equipoise.devices.kuka.velocity_guard", *map(str, files)],
            pass_fds=files,
            # Ctrl-C and a closed terminal reach the driver, which then brings the arm to rest.
            start_new_session=True,
            stdin=subprocess.DEVNULL,
        )
    return SocketTransport(own)


def serve(driver: socket.socket, server: socket.socket, guard: VelocityGuard) -> None:
    """Pass bytes both ways until one end closes its link; act when the guard has to."""
    driving = True
    for end in (driver, server):
        end.setblocking(False)
    while not guard.done:
        ends = [driver, server] if driving else [server]
        ready, _, _ = select.select(ends, [], [], 0.2 * PERIOD)
        now = time.monotonic()
        if driver in ready:
            data = _received(driver)
            server.sendall(guard.hear(data, now))
            if not data:
                guard.act(now)
        server.sendall(guard.due(now))
        if guard.acts and driving:
            driving = False
            driver.close()  # the driver learns it at once
        if server in ready:
            data = _received(server)
            if not data:
                return
            if driving:
                with suppress(BrokenPipeError):
                    driver.sendall(data)
    # The server closes the connection once it has read the end.
    server.settimeout(1.0)
    with suppress(TimeoutError):
        while _received(server):
            pass


def _received(end: socket.socket) -> bytes:
    """Return received bytes; none if the other end has closed the link."""
    try:
        return end.recv(CHUNK)
    except (ConnectionError, TimeoutError):
        return b""


def main() -> None:
    """Run the guard of two open sockets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("server", type=int, help="file descriptor of the connection to the server")
    parser.add_argument("driver", type=int, help="file descriptor of the link to the driver")
    given = parser.parse_args()
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    with (
        socket.socket(fileno=given.server) as server,
        socket.socket(fileno=given.driver) as driver,
        suppress(ConnectionError),
    ):
        server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        serve(driver, server, VelocityGuard())


if __name__ == "__main__":
    main()
