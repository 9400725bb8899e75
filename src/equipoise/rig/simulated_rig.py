"""Simulated rig: an arm and a pendulum in MuJoCo with an operator's hand and button, in time.

`EmulatedOperator` uses them as the messages of a run ask, and types the expected answers.

The arm is that of a twin (`SimulatedRig`) with an emulated servo, or of another simulator.
Virtual time drives it by `clock.attach(bench.advance)`, real time by calls of `advance` with the
time: the rig catches up in whole milliseconds. Equal seeds and equal acts at equal times give equal
motion.

Each fault of the bodies is a method: `push`, `touch`, `slip`, and `stop` of the arm.
"""

from collections.abc import Callable, Sequence
from math import pi, radians
from typing import Any, NamedTuple

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arrays import Array
from equipoise.control.ticks import OperatorMessage
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.interfaces import Clock
from equipoise.simulation.twin.hand import Hand, HandParams, Side, draw_hand_params
from equipoise.simulation.twin.physics import TICK, rod_centre, rod_inertia
from equipoise.simulation.twin.simulated_arm import SimulatedArm
from equipoise.simulation.twin.twin import FLANGE, ROD, Twin


class Bodies(NamedTuple):
    """Bodies of a rig that is to be emulated."""

    arm: Arm
    """The arm with its home posture."""
    pendulum: PendulumParameters
    """The true pendulum."""
    settings: TwinSettings
    """Settings of the world."""
    q: Array
    """Free joints at the start [rad], shape (6,)."""
    start: float
    """Start time [s]."""
    seed: int
    """Seed of all random numbers."""


class Bench:
    """A mechanism with the hand and the button of an operator, in time."""

    def __init__(
        self,
        bodies: Bodies,
        data: Any,
        step: Callable[[], object],
        *,
        flange: int,
        rod: int,
        phi: int,
    ) -> None:
        """Stand at a mechanism in MuJoCo.

        Args:
            bodies: What the mechanism simulates.
            data: State of MuJoCo.
            step: Advances the mechanism by a millisecond.
            flange: Number of the flange's body.
            rod: Number of the pendulum's body, whose x axis is across the rod and z along it.
            phi: Index of the pendulum's angle from upright, relative to the flange, in qpos and
                qvel.
        """
        pendulum, settings = bodies.pendulum, bodies.settings
        self.settings = settings
        """The world's numbers."""
        self._data, self._step = data, step
        self._flange, self._rod, self._phi = flange, rod, phi
        self._reach = rod_centre(pendulum.w2)
        self.hand = Hand(rod_inertia(pendulum.w2, settings.pendulum_mass), self._reach)
        """Hand of the operator, at the middle of the rod."""
        self._random = np.random.default_rng(bodies.seed)
        self._start, self._ticks = bodies.start, 0
        self._down_until = self._slip = 0.0

    @property
    def now(self) -> float:
        """The time [s]."""
        return self._start + self._ticks * TICK

    def advance(self, now: float) -> None:
        """Advance in milliseconds to a time [s]."""
        due = round((now - self._start) / TICK)
        while self._ticks < due:
            self._grasp()
            self._step()
            self._ticks += 1

    @property
    def phi(self) -> float:
        """Angle of the pendulum from upright, relative to the flange, beyond a turn [rad]."""
        return float(self._data.qpos[self._phi])

    @property
    def theta(self) -> float:
        """Angle that an encoder measures: from hanging, relative to the flange [rad]."""
        return pi - self.phi + self._slip

    @property
    def button(self) -> bool:
        """Whether the button is down."""
        return self.now < self._down_until

    def press(self) -> None:
        """Press the button for a tenth of a second."""
        self._down_until = self.now + 0.1

    def lift(self, side: Side | None = None) -> HandParams:
        """Grip the pendulum, bring it upright, and hold it until `let_go`.

        Args:
            side: Side of the lift (default: drawn).

        Returns:
            The parameters of the hand; the caller releases after their time of holding.
        """
        manner = draw_hand_params(self._random, side=side, clumsy=0.0)
        self.hand.lift(self.now, self.phi, manner)
        return manner

    def steady(self) -> None:
        """Grip the pendulum, bring it to hang, and hold it until `let_go`."""
        self.hand.steady(self.now, self.phi, draw_hand_params(self._random, clumsy=0.0))

    def hold_deflected(self) -> None:
        """Grip the pendulum and hold it deflected until `let_go`, which starts a free swing."""
        manner = draw_hand_params(self._random, clumsy=0.0)
        self.hand.hold_deflected(self.now, self.phi, radians(50.0), manner)

    def let_go(self) -> None:
        """Release the pendulum."""
        self.hand.release(self.now)

    def push(self, rate: float) -> None:
        """Push the pendulum, which changes its rate [rad/s]."""
        self.hand.push(self.now, rate)

    def touch(self, force: Sequence[float] | Array) -> None:
        """Press on the middle of the bracket, beside the flange, from now on.

        Args:
            force: Force in base axes [N], shape (3,); zero ends the contact.
        """
        force = np.asarray(force, np.float64)
        self._data.xfrc_applied[self._flange, :3] = force

    def slip(self, angle: float) -> None:
        """Slip the encoder on its spindle, which adds an offset to its angle from now on [rad]."""
        self._slip += angle

    def _grasp(self) -> None:
        """Apply the force of the hand at the middle of the rod, across it."""
        data, rod = self._data, self._rod
        if self.hand.idle:
            data.xfrc_applied[rod, :3] = 0.0
            return
        phi_dot = float(data.qvel[self._phi])
        torque = self.hand.torque(self.now, self.phi, phi_dot)
        across = data.xmat[rod, 0::3]
        data.xfrc_applied[rod, :3] = torque / self._reach * across


class SimulatedRig(Bench):
    """A twin with hand and button, in time."""

    def __init__(self, bodies: Bodies, phi: float = pi) -> None:
        """Set up a rig, the arm at rest.

        Args:
            bodies: Arm, pendulum and world.
            phi: Angle of the pendulum from upright [rad]; it hangs if not given.

        Raises:
            ArmError: The masses of the arm's links are unknown.
        """
        arm, pendulum, settings, q, _, seed = bodies
        self.joints = len(arm.joints)
        """Number of joints of the arm."""
        self.twin = Twin(arm, pendulum, settings, seed=seed)
        self.twin.reset(q, phi)
        self.body = SimulatedArm(self.twin)
        """Arm that an emulated robot moves and measures."""
        super().__init__(
            bodies, self.twin.data, self._tick, flange=FLANGE, rod=ROD, phi=self.joints
        )

    def _tick(self) -> None:
        self.body.tick()
        self.twin.advance(TICK)


class EmulatedOperator:
    """Operator at a simulated rig, who perceives a run by its messages.

    Each request is met after a reaction time, with the first expected answer and with the hand.
    Equal seeds and equal messages at equal times give equal acts.
    """

    def __init__(self, bench: SimulatedRig, clock: Clock, *, seed: int = 0) -> None:
        """Stand at a simulated rig, idle.

        Args:
            bench: The rig; its own seed draws how the hand acts.
            clock: Time of the messages.
            seed: Seed of the reaction times.
        """
        self._clock, self._random = clock, np.random.default_rng(seed)
        self._due: list[tuple[float, str, str]] = []
        self.acts: dict[str, Callable[[], object]] = {
            "hang": bench.steady,
            "reference": lambda: (bench.let_go(), bench.press()),
            "lift": bench.lift,
            "armed": bench.let_go,
            "nudge": lambda: (bench.let_go(), bench.push(0.1)),
            "disarmed": bench.lift,
        }
        """Act of the hand for each message that asks for one, by its name."""

    def notify(self, event: OperatorMessage) -> None:
        """Receive a message, and plan the answer to it."""
        if event.name in self.acts or event.answers:
            moment = self._clock.now() + float(self._random.uniform(0.3, 1.0))  # [s]: assumed
            self._due.append((moment, next(iter(event.answers), ""), event.name))

    def read_input(self) -> list[str]:
        """Carry out the acts that are due, and return the words typed by now."""
        now = self._clock.now()
        due = [act for act in self._due if act[0] <= now]
        self._due = [act for act in self._due if act[0] > now]
        for _, _, name in due:
            if name in self.acts:
                self.acts[name]()
        return [word for _, word, _ in due if word]
