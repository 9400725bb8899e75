"""Emulation of a rig's hardware in real time: a KST server on a TCP port, a board on a terminal.

Both share one simulated rig, and differ from real devices only in their addresses. The operator's
acts are words.

Like a real server, the emulated one serves one client and ends with it; another client is accepted
by the system and gets no reply. After a farewell it starts again. A client that vanishes leaves the
servo on, until the word `start` starts the server again.

After a stall of the host the bodies jump: the simulation catches up, but bytes that a client sent
meanwhile arrive late. Stalls are reported.
"""

import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import radians
from typing import Final

import numpy as np

from equipoise.errors import OutsideError
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import ignore
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import CHUNK
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.terminal import Terminal
from equipoise.robots.kst.server_emulator import KstServer

PERIOD: Final = 0.001
"""Period of the service loop [s]."""
START_OFFSET: Final = np.radians([-6.0, 3.0, 4.0, 0.0, -3.0, 0.0])
"""Offset of the free joints from home at the start [rad]."""


class Emulation:
    """Emulated arm, pendulum, robot and encoder board, in real time."""

    def __init__(
        self,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: TwinSettings,
        clock: Clock,
        *,
        seed: int = 0,
        say: Callable[[str], None] = ignore,
    ) -> None:
        """Switch all parts on; clients can connect to the robot during `run`.

        Args:
            arm: The arm with its home posture.
            pendulum: The true pendulum.
            settings: Settings of the world.
            clock: Clock of the machine.
            seed: Seed of all random numbers.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            OutsideError: The system has no pseudo-terminals.
        """
        lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
        q = np.clip(arm.home_free + START_OFFSET, lower, upper)
        bench = SimulatedRig(arm, pendulum, settings, seed=seed, start=clock.now(), q=q)
        self.arm, self.bench = arm, bench
        """Arm, and simulated rig behind robot and board."""
        self._clock, self._say, self._seed = clock, say, seed
        _warm_up(bench)
        self._board = Board(
            lambda: bench.theta, settings.counts_per_rev, start=clock.now(), seed=seed
        )
        self.terminal = Terminal(self._board)
        """Terminal of the board."""
        self._last = clock.now()
        self._restarts = False
        self.acts: Mapping[str, Callable[[], object]] = {
            "press": bench.press,
            "lift": lambda: bench.lift(clumsy=0.0),
            "aside": bench.hold_deflected,
            "release": bench.let_go,
            "steady": bench.steady,
            "push": lambda: bench.push(radians(20.0)),
            "estop": lambda: bench.body.stop("emergency stop"),
            "free": bench.body.set_free,
            "start": lambda: setattr(self, "_restarts", True),
        }
        """Actions at the rig, by the word that triggers them."""

    def run(
        self, host: str, port: int, stop: Callable[[], bool], listening: Callable[[int], None]
    ) -> None:
        """Serve one client after the other until stopped.

        Args:
            host: Address to listen on.
            port: Port to listen on; for 0 the system chooses one, which then stays.
            stop: Returns whether to stop; called each millisecond.
            listening: Receives the port, once a client can connect for the first time.

        Raises:
            OutsideError: The port is not available.
        """
        try:
            while True:
                port = self._serve(host, port, stop, listening)
                self.bench.body.servo(False)
                listening = ignore
                if stop():
                    break
                self._say("the robot's server has ended, and starts again")
        finally:
            self.terminal.close()

    def _serve(
        self, host: str, port: int, stop: Callable[[], bool], listening: Callable[[int], None]
    ) -> int:
        """Serve one client until its farewell or a restart; return the port."""
        clock, bench = self._clock, self.bench
        server = KstServer(bench.body, bench.joints, seed=self._seed)
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            raise OutsideError(
                f"cannot listen on {host}, port {port} ({error}); stop what uses it, or choose "
                "another"
            ) from None
        client: socket.socket | None = None
        self._restarts = served = False
        with listener:
            listener.setblocking(False)
            port = listener.getsockname()[1]
            listening(port)
            moment = self._last = clock.now()  # the callback does not count as a stall
            while not (stop() or self._restarts or (server.closed and not server.busy)):
                moment = max(moment + PERIOD, clock.now() - 10.0 * PERIOD)
                clock.wait_until(moment)
                now = clock.now()
                self._advance(now)
                if not served:
                    with suppress(BlockingIOError):
                        client = listener.accept()[0]
                        client.setblocking(False)
                        served = True
                if client is None:
                    server.advance(now)
                elif not _exchange(client, server, now):
                    client.close()
                    client = None
                    if not server.closed:
                        server.vanished(now)
                        self._say("the client has vanished; a running servo continues until start")
        if client is not None:
            client.close()
        return port

    def _advance(self, now: float) -> None:
        """Advance all parts but the server to a time [s]."""
        late, self._last = now - self._last, now
        if late > 20.0 * PERIOD:
            self._say(f"the host stalled for {1e3 * late:.0f} ms")
        self.bench.advance(now)
        self._board.press(self.bench.button)
        self.terminal.advance(now)


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
