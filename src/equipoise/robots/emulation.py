"""Emulation of a rig's hardware in real time: a robot on a TCP port, a board on a terminal.

Both share one simulated rig, and differ from real devices only in their addresses. The operator
acts on sight (`equipoise.rig.emulated_operator`) or on typed words. The robot's plugin
provides the robot's emulator.

Like a KST server, the emulated robot serves one client and ends with it. The system accepts the
connection of another client, which gets no reply. The emulated operator restarts it: at once after
a farewell, and some seconds after a client has vanished (until then the servo continues). Without
that operator, the word `start` restarts it.

After a stall of the host the bodies jump: the simulation catches up, but bytes that a client sent
meanwhile arrive late. Stalls are reported.
"""

import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf, radians
from typing import Final

import numpy as np

from equipoise.errors import InputError, OutsideError
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.emulated_operator import SightedOperator
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import Emulator, ignore, robot_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import CHUNK
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.terminal import Terminal
from equipoise.user_code import guest_code

PERIOD: Final = 0.001
"""Period of the service loop [s]."""
RESTART: Final = 1.0
"""Time in which the emulated operator restarts the robot [s]."""
NOTICED: Final = 10.0
"""Time after which the emulated operator notices a vanished client [s]."""
STALL: Final = 0.020
"""Delay above which the host counts as stalled [s]."""
START_OFFSET: Final = np.radians([-6.0, 3.0, 4.0, 0.0, -3.0, 0.0])
"""Offset of the free joints from home at the start [rad]."""
PUSH: Final = radians(20.0)
"""Change of the pendulum's rate by the word `push` [rad/s]."""


class Emulation:
    """Emulated arm, pendulum, operator, robot and encoder board, in real time."""

    def __init__(
        self,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: TwinSettings,
        clock: Clock,
        *,
        clumsy: float | None = 0.0,
        robot: str = "kst",
        faults: str = "",
        seed: int = 0,
        say: Callable[[str], None] = ignore,
    ) -> None:
        """Switch all parts on; clients can connect to the robot during `run`.

        Args:
            arm: The arm with its home posture.
            pendulum: The true pendulum.
            settings: Settings of the world.
            clock: Clock of the machine.
            clumsy: Probability that the emulated operator releases the pendulum with a push or a
                drag; None without that operator.
            robot: Scheme of the emulated robot.
            faults: Faults of the robot's replies, in the syntax of its plugin.
            seed: Seed of all random numbers.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            InputError: The robot has no emulator on a port, or a fault is unknown.
            OutsideError: The system has no pseudo-terminals.
        """
        plugin = robot_plugin(robot)
        serve, settings = plugin.serve, settings.model_copy(update=dict(plugin.servo))
        if serve is None:
            raise InputError(f"the robot {robot!r} has no emulator on a port; choose another")
        lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
        q = np.clip(arm.home_free + START_OFFSET, lower, upper)
        bench = SimulatedRig(arm, pendulum, settings, seed=seed, start=clock.now(), q=q)
        self.arm, self.bench = arm, bench
        """Arm, and simulated rig behind robot and board."""
        self._clock, self._say, self._attended = clock, say, clumsy is not None
        _warm_up(bench)

        def emulator() -> Emulator:
            with guest_code(f"the emulator of {robot}"):
                return serve(bench, arm, faults, seed)

        self._emulator, self._server = emulator, emulator()
        self._board = Board(
            lambda: bench.theta, settings.counts_per_rev, start=clock.now(), seed=seed
        )
        self.terminal = Terminal(self._board)
        """Terminal of the board."""
        if clumsy is not None:
            bench.watch(SightedOperator(bench, clumsy=clumsy, say=say).look)
        self._last = clock.now()
        self._restart_at = inf
        self.stalls = 0
        """Number of stalls of the host."""
        self.acts: Mapping[str, Callable[[], object]] = {
            "press": bench.press,
            "lift": lambda: bench.lift(clumsy=clumsy or 0.0),
            "aside": bench.hold_deflected,
            "release": bench.let_go,
            "steady": bench.steady,
            "push": lambda: bench.push(PUSH),
            "estop": lambda: bench.body.stop("emergency stop"),
            "free": bench.body.set_free,
            "start": lambda: self._restart(0.0),
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
            while not stop():
                port = self._serve(host, port, stop, listening)
                listening = ignore
                self.bench.body.servo(False)
                if stop():
                    break
                if self._restart_at == inf:
                    self._say("the robot's server has ended")
                    self._restart(RESTART if self._attended else inf)
                while not stop() and self._clock.now() < self._restart_at:
                    self._clock.wait_until(self._clock.now() + PERIOD)
                    self._work(self._clock.now())
                if not stop():
                    self._server, self._restart_at = self._emulator(), inf
                    self._say("the robot's server has been started")
        finally:
            self.terminal.close()

    def _restart(self, delay: float) -> None:
        """End the server, and start it again after a delay [s]."""
        self._restart_at = self._clock.now() + delay

    def _serve(
        self, host: str, port: int, stop: Callable[[], bool], listening: Callable[[int], None]
    ) -> int:
        """Serve one client until its farewell or a restart; return the port."""
        server, clock = self._server, self._clock
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            raise OutsideError(
                f"cannot listen on {host}, port {port} ({error}); stop what uses it, or choose "
                "another"
            ) from None
        client: socket.socket | None = None
        served = False
        with listener:
            listener.setblocking(False)
            port = listener.getsockname()[1]
            listening(port)
            moment = self._last = clock.now()  # the callback does not count as a stall
            while not stop() and not (server.closed and not server.busy):
                moment = max(moment + PERIOD, clock.now() - 10.0 * PERIOD)
                clock.wait_until(moment)
                now = clock.now()
                if now >= self._restart_at:
                    break
                self._work(now)
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
                        self._say("the client has vanished; a running servo continues")
                        self._restart(NOTICED if self._attended else inf)
        if client is not None:
            client.close()
        return port

    def _work(self, now: float) -> None:
        """Advance all parts but the server to a time [s]."""
        late = now - self._last
        self._last = now
        if late > STALL:
            self.stalls += 1
            self._say(f"the host stalled for {1e3 * late:.0f} ms")
        self.bench.advance(now)
        self._board.press(self.bench.button)
        self.terminal.advance(now)


def _exchange(client: socket.socket, server: Emulator, now: float) -> bool:
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
