"""Trials on the digital twin: worlds `twin:NAME` and `twin:FILE`."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from equipoise.arm.arm import FREE_JOINTS
from equipoise.arrays import Array, fields, new_records, rows_of
from equipoise.control.control_step import make_controller_params
from equipoise.control.policy import PolicyKernel
from equipoise.elementary import BATCH_SIZE
from equipoise.model.worlds import World, pendulum_on, read_world
from equipoise.safety.trial import new_trial_monitor, trial_safety
from equipoise.simulation.interface import ClosedLoop, Measurement, Setup, Simulation
from equipoise.simulation.plant import scaled
from equipoise.simulation.trials import Trial, Trials, draw_trials
from equipoise.simulation.twin.trial import (
    TwinState,
    TwinWorld,
    advance_alone,
    release_alone,
    run_trials,
)
from equipoise.simulation.twin.twin import Twin


class TwinSimulation(Simulation):
    """Trials on a digital twin."""

    PIECE: ClassVar[int] = 1

    def __init__(self, world: str | World, setup: Setup, *, seed: int, stream: int) -> None:
        """Set up a simulation; see `Simulation`.

        Raises:
            ArmError: The masses of the arm's links are unknown, or home is a singular posture.
            SettingsError: The world does not exist, or the delay exceeds the controller's history.
        """
        world = world if isinstance(world, World) else read_world(world)
        super().__init__(world, setup, seed=seed, stream=stream)
        numbers = self.twin = self.numbers = world.settings
        arm, settings, actuator, h = setup.arm, setup.settings, setup.actuator, setup.h
        self.params = make_controller_params(
            arm, settings, actuator, self.pendulum, h=h, counts_per_rev=numbers.counts_per_rev
        )
        """Constants of the controller."""
        self.safety = trial_safety(arm, numbers, actuator, h, settings.plant.max_speed)
        """Safety limits of a trial."""
        self._idle: list[TwinLoop] = []

    def draw(self, count: int, first: int = 0) -> Trials:
        """Draw the conditions of `count` trials from number `first` on.

        I and b vary by the parameters of the twin; the twin draws jitter, noise and the zero error
        of the encoder by itself.
        """
        sigmas = {name: getattr(self.numbers, name) for name in ("inertia_sigma", "friction_sigma")}
        plant = self.setup.settings.plant.model_copy(update=sigmas)
        settings = self.setup.settings.model_copy(update={"plant": plant})
        return draw_trials(count, settings, self.seed, self.stream, first)

    def loop(self) -> "TwinLoop":
        """Return a closed loop for `reset`."""
        return TwinLoop(self)

    def run_piece(
        self, policy: PolicyKernel, trials: Trials, rows: Sequence[int], duration: float
    ) -> None:
        """Run trials of a compiled policy in this thread; see `Simulation.run`."""
        max_steps = round(duration / self.params.h)
        try:
            loop = self._idle.pop()  # of a thread that has finished
        except IndexError:
            loop = self.loop()
        for row in rows:
            world = loop.prepare(trials.trial(row))
            run_trials(world, policy, trials, np.array([row]), max_steps)
        self._idle.append(loop)


class TwinLoop(ClosedLoop):
    """Closed loop on a twin, which the trials use in turn."""

    def __init__(self, simulation: TwinSimulation) -> None:
        """Build the twin, and allocate the controller."""
        arm, nominal = simulation.setup.arm, simulation.pendulum
        self._simulation = simulation
        self._twin = Twin(arm, nominal, simulation.numbers)
        states = new_records(TwinState)
        self._state = fields(states, TwinState)
        self.params, self.controller = simulation.params, self._state.controller
        monitor = new_trial_monitor(arm, simulation.safety)
        rows, q = rows_of(states, BATCH_SIZE), np.zeros(FREE_JOINTS)
        self._world = TwinWorld(*self._twin.args, self.params, states, rows, q, monitor, 0, 0)

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        release_alone(self.prepare(trial), trial.start)
        self.now, self.tracked = 0.0, 0.0

    def prepare(self, trial: Trial) -> TwinWorld:
        """Return the world with the pendulum of a trial, before its release."""
        simulation, own = self._simulation, trial.variation
        varied = scaled(simulation.pendulum, own.inertia_factor, own.friction_factor)
        self.pendulum = pendulum_on(simulation.setup.pendulum, simulation.numbers, varied)
        self._twin.set_trial(self.pendulum, simulation.seed, trial.number)
        self.zero = float(self._twin.state.zero)
        return self._world._replace(seed=simulation.seed, stream=simulation.stream)

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        self.controller.u[0], x_dot = u, float(self._state.state.x_dot[0])
        advance_alone(self._world)
        moved = float(self._state.state.x_dot[0]) - x_dot
        self.tracked, self.now = moved / self.params.h, self._twin.now
        return int(self._state.cause[0])

    def push(self, rate: float) -> None:
        """Push the pendulum, which changes its rate [rad/s]."""
        self._twin.data.qvel[-1] += rate

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        true = self._state.state
        return np.array([true.x[0], true.x_dot[0], true.phi[0], true.phi_dot[0]])

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        return self._twin.data.qpos[:-1].copy()

    def measurement(self) -> Measurement:
        """Return the newest measurements."""
        return Measurement(*self._twin.encoder(), *self._twin.measured())
