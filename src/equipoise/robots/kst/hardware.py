"""KST server on a TCP port, in front of a simulated rig in real time.

Like a real server, the emulated one serves one client and ends with it; another client is accepted
by the system and gets no reply. After a farewell it starts again. A client that vanishes leaves the
servo on, until the word `start` starts the server again.
"""

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from equipoise.errors import OutsideError
from equipoise.rig.plugins import Bodies, simulated_rig
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import CHUNK
from equipoise.robots.kst.codec import PORT
from equipoise.robots.kst.server_emulator import KstServer

HOST: Final = "127.0.0.1"
"""Address to listen on: this machine."""


class KstHardware:
    """A cabinet with its server, and the arm of a twin."""

    def __init__(self, bodies: Bodies, port: int | None, say: Callable[[str], None]) -> None:
        """Switch arm and cabinet on.

        Args:
            bodies: Arm, pendulum and world.
            port: Port to listen on; for 0 the system chooses one.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            OutsideError: The port is not available.
        """
        port = PORT if port is None else port
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise OutsideError(
                f"cannot listen on {HOST}, port {port} ({error}); stop what uses it, or choose "
                "another"
            ) from None
        self._listener.setblocking(False)
        self.address = f"kst://{HOST}:{self._listener.getsockname()[1]}"
        """Address of the robot."""
        self.bench = simulated_rig(bodies)
        """Bench with the arm."""
        body = self.bench.body
        _warm_up(self.bench)
        self._say, self._restarts = say, False
        self.acts: dict[str, Callable[[], object]] = {
            "estop": lambda: body.stop("emergency stop"),
            "free": body.set_free,
            "start": lambda: setattr(self, "_restarts", True),
        }
        """Actions at the robot, by the word that triggers them."""
        self._begin()

    def advance(self, now: float) -> None:
        """Advance the arm to a time [s], and serve the client."""
        self.bench.advance(now)
        server = self._server
        if self._client is None and not (server.deserted or server.closed):
            with suppress(BlockingIOError):
                self._client = self._listener.accept()[0]
                self._client.setblocking(False)
        if self._client is None:
            server.advance(now)
        elif not _exchange(self._client, server, now):
            self._client.close()
            self._client = None
            if not server.closed:
                server.vanished(now)
                self._say("the client has vanished; a running servo continues until start")
        if self._restarts or (server.closed and not server.busy):
            self.bench.body.servo(False)
            self._say("the robot's server has ended, and starts again")
            self._end()
            self._begin()

    def close(self) -> None:
        """Switch the cabinet off."""
        self.bench.body.servo(False)
        self._end()
        self._listener.close()

    def _begin(self) -> None:
        """Start a server."""
        self._server = KstServer(self.bench.body)
        self._client: socket.socket | None = None
        self._restarts = False
        with suppress(BlockingIOError):  # whoever called the server before is not served any more
            while True:
                self._listener.accept()[0].close()

    def _end(self) -> None:
        if self._client is not None:
            self._client.close()


def _exchange(client: socket.socket, server: KstServer, now: float) -> bool:
    """Pass bytes both ways, and return whether the connection stays open."""
    try:
        with suppress(BlockingIOError):
            data = client.recv(CHUNK)
            if not data:
                server.advance(now)
                return False
            server.feed(data, now)
        for segment in server.advance(now):
            client.send(segment)
    except OSError:
        return False
    return not server.closed


def _warm_up(bench: SimulatedRig) -> None:
    """Call each function that a client needs, since compiling it later would be a stall."""
    body = bench.body
    body.servo(True)
    body.target(body.measured())
    body.torques(external=True)
    bench.advance(bench.now + 0.001)
    body.servo(False)
