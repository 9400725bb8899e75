"""The rig's hardware in real time, on this machine: a KST server on a port, a board on a terminal.

Behind both stands one bench. Who connects cannot tell them from a robot and a board but by the
address. The operator acts on what can be seen
(`equipoise.devices.twin.emulated_operator`), or on words that someone types.

The server ends with each client, as the real one does, and is started again on the smartPAD: by the
emulated operator at once after an `end`, and some seconds after a client has vanished, until when
the servo goes on and nobody else is answered; otherwise by the word `start`.

A host that stalls lets the bodies jump: time is made up for, but what a client sent meanwhile
arrives late. It is reported.
"""

from collections.abc import Callable, Mapping
from math import radians
from pathlib import Path
from typing import Final

import numpy as np

from equipoise.devices.encoder.board import Board
from equipoise.devices.encoder.terminal import Terminal
from equipoise.devices.interfaces import Clock
from equipoise.devices.kuka.listener import serve
from equipoise.devices.kuka.server_emulator import Faults, KstServer
from equipoise.devices.twin.emulated_operator import EmulatedOperator
from equipoise.devices.twin.simulated_rig import SimulatedRig
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import Floats
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.sim_configs import TwinSettings

STALL: Final = 0.020
"""A host that is later than this has stalled [s]."""
RESTART: Final = 1.0
"""The emulated operator takes so long to start the server again [s] ..."""
NOTICED: Final = 10.0
"""... and so long to notice that its client has vanished."""
AWAY: Final = np.radians([-6.0, 3.0, 4.0, 0.0, -3.0, 0.0])
"""How far from home the arm stands when it is switched on, free joints [rad]."""
PUSH: Final = radians(20.0)
"""Change of the pendulum's rate by the word `push` [rad/s]."""

Say = Callable[[str], None]


def away_from_home(arm: Arm) -> Floats:
    """Return where the arm stands when it is switched on, free joints [rad], shape (6,)."""
    return arm.home_free + AWAY


class Emulation:
    """Arm, pendulum, operator, KST server and encoder board, in real time."""

    def __init__(
        self,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: TwinSettings,
        clock: Clock,
        *,
        operator: bool = True,
        clumsy: float = 0.0,
        faults: Faults | None = None,
        link: Path | None = None,
        seed: int = 0,
        say: Say = lambda _: None,
    ) -> None:
        """Switch everything on; nobody can connect to the robot before `run`.

        Args:
            arm: An iiwa with its home posture.
            pendulum: The pendulum as it is.
            settings: The world's numbers.
            clock: The machine's clock.
            operator: Whether an emulated operator acts on what can be seen.
            clumsy: Chance that the operator lets go with a push or a drag.
            faults: Of the link to the robot.
            link: A second name for the board's terminal.
            seed: Seed of all that is random.
            say: Is told what happens, in words.

        Raises:
            ArmError: The masses of the arm's links are not known.
            InputError: The link's name is that of a file.
            OutsideError: There are no pseudo-terminals here.
        """
        self._clock, self._say = clock, say
        self._speeds = [joint.velocity for joint in arm.joints]
        self._faults, self._seed = faults or Faults(), seed
        bench = SimulatedRig(
            arm, pendulum, settings, seed=seed, start=clock.now(), q=away_from_home(arm)
        )
        self.bench = bench
        """What stands behind it all."""
        _warm_up(bench)
        # The rest may take its time from here on: the arm just stands there.
        counts_per_rev = settings.counts_per_rev
        self._board = Board(
            lambda: bench.theta, counts_per_rev=counts_per_rev, start=clock.now(), seed=seed
        )
        self._terminal = Terminal(self._board, link)
        self._down = False
        self._operator = operator
        if operator:
            bench.watch(EmulatedOperator(bench, clock, clumsy=clumsy, say=say).look)
        self._server: KstServer | None = None
        self._restarted = False
        self._vanished: float | None = None
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
            "start": self._restart,
        }
        """What one can do at the bench, by a word."""

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
            stop: Says when to stop; asked each millisecond.
            listening: Takes the port, once a client can connect for the first time.

        Raises:
            OutsideError: The port cannot be had.
        """
        begun = False

        def heard(number: int) -> None:
            nonlocal begun, port
            if not begun:
                listening(number)
                self._last = self._clock.now()  # whatever that took
            begun, port = True, number

        self._last = self._clock.now()
        try:
            while not stop():
                server = KstServer(
                    self.bench.body, self._speeds, faults=self._faults, seed=self._seed
                )
                self._server, self._restarted, self._vanished = server, False, None
                serve(
                    server,
                    host,
                    port,
                    self._clock,
                    self._work,
                    lambda: stop() or self._restarted,
                    listening=heard,
                )
                self._server = None
                self.bench.body.servo(False)
                if not stop():
                    self._wait_for_restart(stop)
        finally:
            self._terminal.close()

    def _wait_for_restart(self, stop: Callable[[], bool]) -> None:
        """Let time pass without a server until it is started again."""
        if not self._restarted:
            self._say("the server's application has ended")
        until = self._clock.now() + RESTART
        while not stop() and not self._restarted:
            if self._operator and self._clock.now() > until:
                break
            self._clock.wait_until(self._clock.now() + 0.001)
            self._work(self._clock.now())
        if not stop():
            self._say("the server's application has been started on the smartPAD")

    def _restart(self) -> None:
        self._restarted = True

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
        if self._server is not None and self._server.deserted:
            self._mind_the_deserted(now)

    def _mind_the_deserted(self, now: float) -> None:
        if self._vanished is None:
            self._vanished = now
            self._say("the client has vanished; its servo, if any, goes on")
        elif self._operator and now > self._vanished + NOTICED:
            self._restart()


def _warm_up(bench: SimulatedRig) -> None:
    """Do once what a client asks for: to compile it, or to load it, would be a stall later."""
    body = bench.body
    body.servo(True)
    body.target(body.measured())
    body.torques(external=True)
    bench.advance(bench.now + 0.001)
    body.servo(False)
