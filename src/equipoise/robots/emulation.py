"""Emulation of a rig's hardware in real time: a KST server on a TCP port, a board on a terminal.

Both share one simulated rig, and differ from real devices only in their addresses. The operator's
acts are words.

Like a real server, the emulated one serves one client and ends with it; another client is accepted
by the system and gets no reply. After a farewell it starts again. A client that vanishes leaves the
servo on, until the word `start` starts the server again.

After a stall of the host the bodies jump: the simulation catches up, but bytes that a client sent
meanwhile arrive late. Stalls are reported.
"""

import os
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from math import radians
from pathlib import Path
from typing import Final

import numpy as np

from equipoise.errors import InputError, OutsideError
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import ignore
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import CHUNK
from equipoise.robots.encoder.board import Board
from equipoise.robots.kst.server_emulator import KstServer

PERIOD: Final = 0.001
"""Period of the service loop [s]."""
START_OFFSET: Final = np.radians([-6.0, 3.0, 4.0, 0.0, -3.0, 0.0])
"""Offset of the free joints from home at the start [rad]."""


class Terminal:
    """Pseudo-terminal with an emulated board behind it; to a client a board on USB."""

    def __init__(self, board: Board, link: Path | None = None) -> None:
        """Open the terminal.

        Args:
            board: The board; its lines are dropped while no client reads, as those of a real board.
            link: Second name of the terminal, a symbolic link; replaces another symbolic link.

        Raises:
            InputError: A file has that name.
            OutsideError: There are no pseudo-terminals here.
        """
        if link is not None and link.exists() and not link.is_symlink():
            raise InputError(f"{link} is a file; give another name for the terminal")
        try:
            import pty
            import tty

            self._ours, self._theirs = pty.openpty()
        except (ImportError, OSError) as error:
            raise OutsideError(
                f"{sys.platform} has no pseudo-terminal for the board ({error}); use Linux or macOS"
            ) from None
        # The client's side stays open here: without a client, reads on our side would fail.
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._board, self._unsent, self._link = board, b"", link
        self.path = Path(os.ttyname(self._theirs))
        """Name of the terminal; its address is `serial://` with this name."""
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self.path)

    def advance(self, now: float) -> None:
        """Transfer bytes both ways; call it about once per period of the board.

        Args:
            now: The time [s].
        """
        with suppress(BlockingIOError):
            self._board.feed(os.read(self._ours, CHUNK))
        sent = self._board.advance(now)
        # A partly written line is finished first; whole lines are lost while no client reads.
        with suppress(BlockingIOError):
            self._unsent = self._unsent[os.write(self._ours, self._unsent) :]
            if not self._unsent:
                self._unsent = sent[os.write(self._ours, sent) :]

    def close(self) -> None:
        """Close the terminal, and remove its second name."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._ours)
        os.close(self._theirs)


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
        link: Path | None = None,
        say: Callable[[str], None] = ignore,
    ) -> None:
        """Switch all parts on; clients can connect to the robot during `run`.

        Args:
            arm: The arm with its home posture.
            pendulum: The true pendulum.
            settings: Settings of the world.
            clock: Clock of the machine.
            seed: Seed of all random numbers.
            link: Second name of the board's terminal.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            InputError: A file has the terminal's second name.
            OutsideError: The system has no pseudo-terminals.
        """
        lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
        q = np.clip(arm.home_free + START_OFFSET, lower, upper)
        bench = SimulatedRig(arm, pendulum, settings, seed=seed, start=clock.now(), q=q)
        self.bench = bench
        """Simulated rig behind robot and board."""
        self._clock, self._say = clock, say
        _warm_up(bench)
        counts, start = settings.counts_per_rev, clock.now()
        self._board = Board(lambda: bench.theta, counts, start=start, seed=seed)
        self.terminal = Terminal(self._board, link)
        """Terminal of the board."""
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
        """Serve one client after the other until stopped; then close the terminal.

        Args:
            host: Address to listen on.
            port: Port to listen on; for 0 the system chooses one.
            stop: Returns whether to stop; called each millisecond.
            listening: Receives the port, once a client can connect.

        Raises:
            OutsideError: The port is not available.
        """
        with closing(self.terminal):
            try:
                listener = socket.create_server((host, port))
            except OSError as error:
                raise OutsideError(
                    f"cannot listen on {host}, port {port} ({error}); stop what uses it, or choose "
                    "another"
                ) from None
            with listener:
                listener.setblocking(False)
                listening(listener.getsockname()[1])
                while not stop():
                    self._serve(listener, stop)
        self.bench.body.servo(False)

    def _serve(self, listener: socket.socket, stop: Callable[[], bool]) -> None:
        """Serve one client until its farewell or a restart."""
        clock, body = self._clock, self.bench.body
        server, client = KstServer(body, self.bench.joints), None
        self._restarts = False
        with suppress(BlockingIOError):  # whoever called the server before is not served any more
            while True:
                listener.accept()[0].close()
        moment = last = clock.now()
        while not (self._restarts or (server.closed and not server.busy)):
            moment = max(moment + PERIOD, clock.now() - 10.0 * PERIOD)
            clock.wait_until(moment)
            now = clock.now()
            if now - last > 20.0 * PERIOD:
                self._say(f"the host stalled for {1e3 * (now - last):.0f} ms")
            last = now
            self.bench.advance(now)
            self._board.press(self.bench.button)
            self.terminal.advance(now)
            if client is None and not (server.deserted or server.closed):
                with suppress(BlockingIOError):
                    client = listener.accept()[0]
                    client.setblocking(False)
            if client is None:
                server.advance(now)
            elif not _exchange(client, server, now):
                client.close()
                client = None
                if not server.closed:
                    server.vanished(now)
                    self._say("the client has vanished; a running servo continues until start")
            if stop():
                break
        else:
            body.servo(False)
            self._say("the robot's server has ended, and starts again")
        if client is not None:
            client.close()


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
