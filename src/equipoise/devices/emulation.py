"""The rig's hardware in real time, on this machine: a robot on a port, a board on a terminal.

One simulated rig stands behind both. Only their addresses tell a client that they are emulated.
The operator acts on what is visible (`equipoise.devices.twin.emulated_operator`), or on typed
words. The robot's plugin provides the robot's emulator.

When the host stalls, the bodies jump: the simulation makes up for the time, but what a client sent
meanwhile arrives late. A stall is reported.
"""

from collections.abc import Callable, Mapping
from math import radians
from pathlib import Path
from typing import Final

import numpy as np

from equipoise.devices.encoder.board import Board
from equipoise.devices.encoder.terminal import Terminal
from equipoise.devices.interfaces import Clock
from equipoise.devices.plugins import ServerOptions, robot_plugin
from equipoise.devices.twin.emulated_operator import EmulatedOperator
from equipoise.devices.twin.simulated_rig import SimulatedRig
from equipoise.errors import InputError
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import Floats
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.sim_configs import TwinSettings

STALL: Final = 0.020
"""A host that is later than this has stalled [s]."""
AWAY: Final = np.radians([-6.0, 3.0, 4.0, 0.0, -3.0, 0.0])
"""Offset of the free joints from home when the emulation begins [rad]."""
PUSH: Final = radians(20.0)
"""Change of the pendulum's rate by the word `push` [rad/s]."""

Say = Callable[[str], None]


def away_from_home(arm: Arm) -> Floats:
    """Return the first posture of the arm, within its limits, free joints [rad], shape (6,)."""
    lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
    return np.clip(arm.home_free + AWAY, lower, upper)


class Emulation:
    """Arm, pendulum, operator, robot's emulator and encoder board, in real time."""

    def __init__(
        self,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: TwinSettings,
        clock: Clock,
        *,
        operator: bool = True,
        clumsy: float = 0.0,
        robot: str = "kst",
        faults: str = "",
        link: Path | None = None,
        seed: int = 0,
        say: Say = lambda _: None,
    ) -> None:
        """Switch everything on; nobody can connect to the robot before `run`.

        Args:
            arm: The arm with its home posture.
            pendulum: The pendulum as it is.
            settings: The world's numbers.
            clock: The machine's clock.
            operator: Whether an emulated operator acts on what can be seen.
            clumsy: Chance that the operator lets go with a push or a drag.
            robot: Scheme of the robot that is emulated.
            faults: Faults of the robot's answers, in the words of its plugin.
            link: A second name for the board's terminal.
            seed: Seed of all that is random.
            say: Is told what happens, in words.

        Raises:
            ArmError: The masses of the arm's links are not known.
            InputError: The link's name is that of a file, the robot has no emulator, or a fault is
                unknown.
            OutsideError: There are no pseudo-terminals here.
        """
        self._clock, self._say = clock, say
        plugin = robot_plugin(robot)
        serve, settings = plugin.serve, settings.model_copy(update=dict(plugin.servo))
        if serve is None:
            raise InputError(f"the robot {robot!r} has no emulator on a port; choose another")
        bench = SimulatedRig(
            arm, pendulum, settings, seed=seed, start=clock.now(), q=away_from_home(arm)
        )
        self.bench = bench
        """What stands behind it all."""
        _warm_up(bench)
        self._server = serve(
            ServerOptions(bench, arm, clock, self._work, say, operator, faults, seed)
        )
        # The rest may take its time from here on: the arm just stands there.
        counts_per_rev = settings.counts_per_rev
        self._board = Board(
            lambda: bench.theta, counts_per_rev=counts_per_rev, start=clock.now(), seed=seed
        )
        self._terminal = Terminal(self._board, link)
        self._down = False
        if operator:
            bench.watch(EmulatedOperator(bench, clock, clumsy=clumsy, say=say).look)
        self._last = clock.now()
        self.stalls = 0
        """How often the host has stalled."""
        self.acts: Mapping[str, Callable[[], object]] = {
            "press": bench.press,
            "lift": lambda: bench.lift(clumsy=clumsy),
            "aside": bench.hold_deflected,
            "release": bench.let_go,
            "steady": bench.steady,
            "push": lambda: bench.push(PUSH),
            "estop": lambda: bench.body.stop("emergency stop"),
            "free": bench.body.set_free,
            **self._server.acts,
        }
        """Actions at the rig, by the word that triggers them."""

    @property
    def terminal(self) -> Path:
        """Where the board's terminal is."""
        return self._terminal.path

    def run(
        self,
        host: str,
        port: int,
        stop: Callable[[], bool],
        *,
        listening: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Serve one client after the other until stopped.

        Args:
            host: Address to listen on.
            port: Port to listen on; 0 lets the system choose one, which then stays.
            stop: Returns whether to stop; asked each millisecond.
            listening: Receives the port, once a client can connect for the first time.

        Raises:
            OutsideError: The port is not available.
        """

        def heard(number: int) -> None:
            listening(number)
            self._last = self._clock.now()  # the time of the callback is no stall

        self._last = self._clock.now()
        try:
            self._server.run(host, port, stop, heard)
        finally:
            self._terminal.close()

    def _work(self, now: float) -> None:
        """Let everything but the server pass until a time [s]."""
        late = now - self._last
        self._last = now
        if late > STALL:
            self.stalls += 1
            self._say(f"the host stalled for {1e3 * late:.0f} ms")
        self.bench.advance(now)
        down = self.bench.button
        if down != self._down:
            self._down = down
            if down:
                self._board.press()
            else:
                self._board.let_go()
        self._terminal.advance(now)


def _warm_up(bench: SimulatedRig) -> None:
    """Do once what a client asks for: to compile it, or to load it, would be a stall later."""
    body = bench.body
    body.servo(True)
    body.target(body.measured())
    body.torques(external=True)
    bench.advance(bench.now + 0.001)
    body.servo(False)
