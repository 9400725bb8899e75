"""`franky-sim` in a process of its own, in lockstep with virtual time.

The driver's library keeps Python's lock while it waits for the controller, so that both cannot
share a process. Each millisecond of virtual time is one cycle of the controller: it processes the
driver's command, moves the arm, and sends its state.
"""

import multiprocessing
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.clocks import DrainingClock, VirtualClock
from equipoise.rig.connection import Rig
from equipoise.rig.emulated_operator import EmulatedOperator
from equipoise.rig.paced import PacedStream
from equipoise.rig.plugins import Bodies, robot_plugin
from equipoise.rig.request import RunRequest
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder
from equipoise.robots.franka.robot import FrankaRobot

POLL: Final = 0.002
"""Real time without a cycle after which a waiting client is served [s]."""


class Lockstep:
    """The rig of another process: its acts, its encoder's bytes, and its time."""

    def __init__(self, bodies: Bodies) -> None:
        """Start the process; see `FrankyRig`."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, bodies), daemon=True)
        self._process.start()
        theirs.close()
        self.host: str = self._pipe.recv()
        """Address of the controller."""
        self.q = np.array(bodies.arm.with_held(bodies.q))
        """True joints [rad], shape (7,)."""

    def advance(self, now: float, to_board: bytes = b"") -> bytes:
        """Advance the rig to a time [s]; pass bytes to the encoder's board, and return its own."""
        self.q, sent = self._call("advance", now, to_board)
        return sent

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return an act of the rig or its controller, such as `lift`."""
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._call, name)

    def _call(self, name: str, *arguments: Any, **options: Any) -> Any:
        self._pipe.send((name, arguments, options))
        return self._pipe.recv()

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(5.0)


def lockstep_rig(request: RunRequest) -> Rig:
    """Return the rig of a request, in lockstep, with its operator.

    Args:
        request: The run.
    """
    settings, clock = read_world("twin:nominal").settings, VirtualClock()
    arm, seed = request.settings.described_arm, request.seed
    pendulum = pendulum_on(request.policy.pendulum, settings)
    q = arm.home_free + 0.1 * np.random.default_rng(seed).uniform(-1.0, 1.0, FREE_JOINTS)
    bench: Any = Lockstep(Bodies(arm, pendulum, settings, q, 0.0, seed))
    here, there = memory_pipe(clock, settings.encoder_age)

    def advance(now: float) -> None:
        there.write(bench.advance(now, there.read()))

    clock.attach(advance)
    sensor = LineEncoder(lambda: here, clock, counts_per_rev=settings.counts_per_rev)
    draining = DrainingClock(clock, sensor)
    stream = PacedStream(FrankaRobot(bench.host, draining), clock, request.policy.h / 2.0, draining)
    operator = EmulatedOperator(bench, clock, seed=seed)
    return Rig(stream, sensor, stream, robot_plugin("franka"), operator, bench)


def _serve(pipe: Any, bodies: Bodies) -> None:
    from equipoise.robots.franka.franky import FrankyRig

    rig = FrankyRig(bodies)
    counts, seed = bodies.settings.counts_per_rev, bodies.seed
    board = Board(lambda: rig.theta, counts_per_rev=counts, seed=seed)
    pipe.send(rig.controller.hostname)
    while True:
        try:
            if not pipe.poll(POLL):
                rig.controller.reply()
                continue
            name, arguments, options = pipe.recv()
        except EOFError:
            return
        if name == "advance":
            now, data = arguments
            rig.advance(now)
            board.feed(data)
            board.press(rig.button)
            pipe.send((np.array(rig.robot.inner_state.q), board.advance(now)))
        else:
            owner = rig if hasattr(rig, name) else rig.controller
            pipe.send(getattr(owner, name)(*arguments, **options))
