"""Trials on the plant of the training: worlds `ideal` and `model`.

With the actuator `ideal` this is the paper's simulation; with any other, the arm follows through
delay, servo and drive, and the controller observes through an encoder.
"""

from typing import ClassVar, NamedTuple

import numpy as np

from equipoise.arrays import Array, IntArray, Records, fields, new_records, rows_of
from equipoise.control.policy import PolicyKernel
from equipoise.control.swing_up import SwingUp, make_swing_up
from equipoise.elementary import BATCH_SIZE
from equipoise.errors import SettingsError
from equipoise.jit import call, inlined, kernel
from equipoise.model.worlds import IDEAL, MODEL, World
from equipoise.simulation.interface import ClosedLoop, Setup, SideBySide, Simulation
from equipoise.simulation.plant import (
    BatchState,
    LoopParams,
    Trial,
    draw_uniform,
    make_loop_params,
    measure,
    scaled,
    to_normal,
)
from equipoise.simulation.trials import Trials, trial_loop


class PlantWorld(NamedTuple):
    """The plant as a world of compiled trials."""

    plant: LoopParams
    """Constants of the closed loop."""
    states: Records
    """`BatchState`."""
    rows: IntArray
    """Its rows of lanes, from `rows_of`."""
    batch_size: int
    """Number of trials that run side by side."""
    seed: int
    """Seed of the trials."""
    stream: int
    """Stream of the noise: selection or test."""
    swing_up: SwingUp
    """Swing-up of trials that begin with a hanging pendulum."""


@inlined
def place(world: PlantWorld, trial: Trial, n: int) -> None:
    """Place lane `n` at the start of a trial, see `plant.reset`, and measure."""
    batch = world.states[0]
    call(world.plant.reset, (world.plant, batch, trial, n))
    if world.plant.controller.has_sensor:
        measure(world.plant.controller, batch)


@inlined
def advance(
    world: PlantWorld, seed: IntArray, tick: IntArray, number: IntArray, lanes: int
) -> None:
    """Advance the first lanes by one step, with the u of their controllers.

    Args:
        world: Changed in place.
        seed: Seed of the noise of each lane.
        tick: Number of steps of each lane.
        number: Number of the trial of each lane.
        lanes: Number of lanes.
    """
    batch = world.states[0]
    noise = batch.controller.noise
    for n in range(lanes):
        draw_uniform(noise, seed[n], tick[n], number[n], world.stream, n)
    to_normal(noise, lanes)
    call(world.plant.step, (world.plant, batch, lanes))


run_trials = kernel(trial_loop(place, advance))
"""Runs trials in all lanes of a batch; see `trial_loop`."""
place_alone, advance_alone = kernel(place), kernel(advance)
"""The same steps, called from Python."""


class PlantSimulation(Simulation):
    """Trials on the plant of the training."""

    BATCH: ClassVar[int] = BATCH_SIZE
    PIECE: ClassVar[int] = 4 * BATCH_SIZE

    def __init__(self, world: str | World, setup: Setup, *, seed: int, stream: int) -> None:
        """Set up the plant; see `Simulation`.

        Raises:
            ArmError: Home is a singular posture.
            SettingsError: The world does not exist, or the delay exceeds the controller's history.
        """
        if world not in (IDEAL, MODEL):
            raise SettingsError(f"there is no world {world}; choose {IDEAL} or {MODEL}")
        super().__init__(world, setup, seed=seed, stream=stream)
        arm, settings = setup.arm, setup.settings
        self.params = make_loop_params(arm, settings, setup.h, self.pendulum, setup.actuator)
        """Constants of the closed loop."""

    def loop(self) -> "PlantLoop":
        """Return a closed loop for `reset`."""
        return PlantLoop(self)

    def run_piece(self, policy: PolicyKernel, duration: float, trials: Trials) -> Trials:
        """Run trials of a compiled policy in this thread; see `Simulation.run_piece`."""
        max_steps = round(duration / self.params.controller.h)
        world = self.world_of(BATCH_SIZE)
        world = world._replace(swing_up=self.law_for(world.swing_up, policy))
        run_trials(world, policy, trials, max_steps)
        return trials

    def side_by_side(self, count: int) -> SideBySide:
        """Return worlds for lanes that advance together."""
        worlds = [self.world_of(BATCH_SIZE) for _ in range(0, count, BATCH_SIZE)]
        return worlds, place, advance, lambda *_: None

    def world_of(self, batch_size: int) -> PlantWorld:
        """Return the world of some trials that run side by side."""
        states = new_records(BatchState)
        rows = rows_of(states, BATCH_SIZE)
        law = make_swing_up(self.params.controller, self.max_speed)
        return PlantWorld(self.params, states, rows, batch_size, self.seed, self.stream, law)


class IdealSimulation(PlantSimulation):
    """Trials on the paper's plant."""

    ideal_arm: ClassVar[bool] = True


class PlantLoop(ClosedLoop):
    """Closed loop of the training, in the first lane of a batch."""

    def __init__(self, simulation: PlantSimulation) -> None:
        """Allocate the state."""
        self._simulation, self._world = simulation, simulation.world_of(1)
        self._batch = fields(self._world.states, BatchState)
        self._seed, self._tick, self._number = np.zeros((3, 1), np.int64)
        self.params, self.controller = simulation.params.controller, self._batch.controller
        self.pendulum = simulation.pendulum

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        own, simulation = trial.variation, self._simulation
        self._seed[0], self._number[0], self._tick[0] = simulation.seed, trial.number, 0
        self.now, self.tracked = 0.0, 0.0
        self._world = self._world._replace(stream=simulation.stream)
        self.pendulum = scaled(simulation.pendulum, own.inertia_factor, own.friction_factor)
        self.zero = own.zero if self.params.has_sensor else None
        place_alone(self._world, trial, 0)

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        self.controller.u[0] = u
        advance_alone(self._world, self._seed, self._tick, self._number, 1)
        self._tick += 1
        self.now = float(self._tick[0]) * self.params.h
        self.tracked = float(self._batch.u_tracked[0])
        return int(self._batch.cause[0])

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        true = self._batch.state
        return np.array([true.x[0], true.x_dot[0], true.phi[0], true.phi_dot[0]])

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        q = self._batch.arm.q if self.params.has_sensor else self.controller.q
        return self._simulation.setup.arm.with_held(q[:, 0])
