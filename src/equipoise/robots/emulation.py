"""Emulation of a rig's hardware in real time: a robot on a port, a board on a terminal.

Both share one simulated rig, and differ from real devices only in their addresses. The operator
acts on sight (`equipoise.rig.emulated_operator`) or on typed words. The robot's plugin
provides the robot's emulator.

After a stall of the host the bodies jump: the simulation catches up, but bytes that a client sent
meanwhile arrive late. Stalls are reported.
"""

from collections.abc import Callable, Mapping
from math import radians
from pathlib import Path
from typing import Final

import numpy as np

from equipoise.errors import InputError
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.emulated_operator import EmulatedOperator
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import ServerOptions, ignore, robot_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.terminal import Terminal
from equipoise.user_code import guest_code

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
        operator: bool = True,
        clumsy: float = 0.0,
        robot: str = "kst",
        faults: str = "",
        link: Path | None = None,
        seed: int = 0,
        say: Callable[[str], None] = ignore,
    ) -> None:
        """Switch all parts on; clients can connect to the robot during `run`.

        Args:
            arm: The arm with its home posture.
            pendulum: The true pendulum.
            settings: Settings of the world.
            clock: Clock of the machine.
            operator: Whether an emulated operator acts on sight.
            clumsy: Probability that the operator releases the pendulum with a push or a drag.
            robot: Scheme of the emulated robot.
            faults: Faults of the robot's replies, in the syntax of its plugin.
            link: Second name of the board's terminal.
            seed: Seed of all random numbers.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            InputError: The link is an existing file, the robot has no emulator, or a fault is
                unknown.
            OutsideError: The system has no pseudo-terminals.
        """
        self._clock, self._say, self.arm = clock, say, arm
        plugin = robot_plugin(robot)
        serve, settings = plugin.serve, settings.model_copy(update=dict(plugin.servo))
        if serve is None:
            raise InputError(f"the robot {robot!r} has no emulator on a port; choose another")
        lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
        q = np.clip(arm.home_free + START_OFFSET, lower, upper)
        bench = SimulatedRig(arm, pendulum, settings, seed=seed, start=clock.now(), q=q)
        self.bench = bench
        """Simulated rig behind robot and board."""
        _warm_up(bench)
        options = ServerOptions(bench, arm, clock, self._work, say, operator, faults, seed)
        with guest_code(f"the emulator of {robot}"):
            self._server = serve(options)
            acts = dict(self._server.acts)
        counts = settings.counts_per_rev
        self._board = Board(lambda: bench.theta, counts, start=clock.now(), seed=seed)
        self._terminal = Terminal(self._board, link)
        self.terminal = self._terminal.path
        """Path of the board's terminal."""
        if operator:
            bench.watch(EmulatedOperator(bench, clock, clumsy=clumsy, say=say).look)
        self._last = clock.now()
        self.stalls = 0
        """Number of stalls of the host."""
        self.acts: Mapping[str, Callable[[], object]] = {
            "press": bench.press,
            "lift": lambda: bench.lift(clumsy=clumsy),
            "aside": bench.hold_deflected,
            "release": bench.let_go,
            "steady": bench.steady,
            "push": lambda: bench.push(PUSH),
            "estop": lambda: bench.body.stop("emergency stop"),
            "free": bench.body.set_free,
            **acts,
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

        def opened(number: int) -> None:
            listening(number)
            self._last = self._clock.now()  # the callback does not count as a stall

        self._last = self._clock.now()
        try:
            self._server.run(host, port, stop, opened)
        finally:
            self._terminal.close()

    def _work(self, now: float) -> None:
        """Advance all parts but the server to a time [s]."""
        late = now - self._last
        self._last = now
        if late > STALL:
            self.stalls += 1
            self._say(f"the host stalled for {1e3 * late:.0f} ms")
        self.bench.advance(now)
        self._board.press(self.bench.button)
        self._terminal.advance(now)


def _warm_up(bench: SimulatedRig) -> None:
    """Call each function that a client needs, since compiling it later would be a stall."""
    body = bench.body
    body.servo(True)
    body.target(body.measured())
    body.torques(external=True)
    bench.advance(bench.now + 0.001)
    body.servo(False)
