"""Hardware of a rig in real time: a robot behind its address, an encoder board on a terminal.

Both share one bench, and differ from real devices only in their addresses. The plugin of the robot
makes the bench. The operator's acts are words.

After a stall of the host the bodies jump: the simulation catches up, but bytes that a client sent
meanwhile arrive late. Stalls are reported.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from math import radians
from pathlib import Path
from typing import Final

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import ignore, robot_plugin
from equipoise.rig.simulated_rig import Bodies
from equipoise.robots.encoder.board import Board, Terminal

PERIOD: Final = 0.001
"""Period of the service loop [s]."""


class Emulation:
    """Emulated arm, pendulum, robot and encoder board, in real time."""

    def __init__(
        self,
        robot: str,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: TwinSettings,
        clock: Clock,
        *,
        port: int | None = None,
        seed: int = 0,
        link: Path | None = None,
        say: Callable[[str], None] = ignore,
    ) -> None:
        """Switch all parts on; clients can connect, and are served during `run`.

        Args:
            robot: Scheme of the robot.
            arm: The arm with its home posture.
            pendulum: The true pendulum.
            settings: Settings of the world.
            clock: Clock of the machine.
            port: Port of the robot, 0 for a free one; None for its usual one.
            seed: Seed of all random numbers.
            link: Second name of the board's terminal.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            InputError: A file has the terminal's second name, or the robot is not emulated.
            OutsideError: The port is not available, or the system has no pseudo-terminals.
        """
        lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
        q = np.clip(arm.home_free + np.radians([-6.0, 3.0, 4.0, 0.0, -3.0, 0.0]), lower, upper)
        bodies = Bodies(arm, pendulum, settings, q, clock.now(), seed)
        self.hardware = robot_plugin(robot).hardware(bodies, port, say)
        """The robot, and the bench with its arm."""
        bench, self._clock, self._say = self.hardware.bench, clock, say
        counts, start = settings.counts_per_rev, clock.now()
        self._board = Board(lambda: bench.theta, counts, start=start)
        self.terminal = Terminal(self._board, link)
        """Terminal of the board."""
        self.acts: Mapping[str, Callable[[], object]] = {
            "press": bench.press,
            "lift": bench.lift,
            "aside": bench.hold_deflected,
            "release": bench.let_go,
            "steady": bench.steady,
            "push": lambda: bench.push(radians(20.0)),
            **self.hardware.acts,
        }
        """Actions at the rig, by the word that triggers them."""

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve clients until stopped; then switch all parts off.

        Args:
            stop: Returns whether to stop; called each millisecond.
        """
        clock = self._clock
        with ExitStack() as parts:
            parts.callback(self.terminal.close)
            parts.callback(self.hardware.close)
            self.hardware.advance(clock.now())  # catches up with the time of switching on
            moment = last = clock.now()
            while not stop():
                moment = max(moment + PERIOD, clock.now() - 10.0 * PERIOD)
                clock.wait_until(moment)
                now = clock.now()
                if now - last > 20.0 * PERIOD:
                    self._say(f"the host stalled for {1e3 * (now - last):.0f} ms")
                last = now
                self.hardware.advance(now)
                self._board.press(self.hardware.bench.button)
                # At the time of the angle, which advances in whole milliseconds.
                self.terminal.advance(self.hardware.bench.now)
