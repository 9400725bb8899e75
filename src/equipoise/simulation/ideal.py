"""Trials on the plant of the training: worlds `ideal` and `model`.

With the actuator `ideal` this is the paper's simulation; with any other, the arm follows through
delay, servo and drive, and the controller observes through an encoder.
"""

from typing import ClassVar, NamedTuple

from equipoise.arrays import Array, IntArray, Records, new_records, rows_of
from equipoise.control.swing_up import SwingUp, make_swing_up
from equipoise.elementary import BATCH_SIZE
from equipoise.errors import SettingsError
from equipoise.jit import call, inlined
from equipoise.model.worlds import IDEAL, MODEL, World
from equipoise.simulation import plant
from equipoise.simulation.interface import CompiledLoop, Setup, Simulation
from equipoise.simulation.trials import kernels_of


class PlantWorld(NamedTuple):
    """The plant as a world of compiled trials."""

    plant: plant.LoopParams
    """Constants of the closed loop."""
    states: Records
    """`BatchState`."""
    rows: IntArray
    """Its rows of lanes, from `rows_of`."""
    swing_up: SwingUp
    """Swing-up of trials that begin with a hanging pendulum."""
    seed: int
    """Seed of the trials."""
    stream: int
    """Stream of the noise: selection or test."""
    batch_size: int = BATCH_SIZE
    """Number of trials that run side by side."""


@inlined
def place(world: PlantWorld, trial: plant.Trial, n: int) -> None:
    """Place lane `n` at the start of a trial, see `plant.reset`, and measure."""
    batch = world.states[0]
    call(world.plant.reset, (world.plant, batch, trial, n))
    batch.time[n] = 0.0
    if world.plant.controller.has_sensor:
        plant.measure(world.plant.controller, batch)


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
        plant.draw_uniform(noise, seed[n], tick[n], number[n], world.stream, n)
    plant.to_normal(noise, lanes)
    call(world.plant.step, (world.plant, batch, lanes))
    for n in range(lanes):
        batch.time[n] = (tick[n] + 1) * world.plant.controller.h


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
        self.params = plant.make_loop_params(arm, settings, setup.h, self.pendulum, setup.actuator)
        """Constants of the closed loop."""

    def loop(self) -> "PlantLoop":
        """Return a closed loop for `reset`."""
        return PlantLoop(self)


class IdealSimulation(PlantSimulation):
    """Trials on the paper's plant."""

    ideal_arm: ClassVar[bool] = True


class PlantLoop(CompiledLoop):
    """Closed loop of the training."""

    KERNELS = kernels_of(place, advance)

    def __init__(self, simulation: PlantSimulation) -> None:
        """Allocate the state."""
        params, states = simulation.params, new_records(plant.BatchState)
        law = make_swing_up(params.controller, simulation.max_speed)
        world = PlantWorld(params, states, rows_of(states, BATCH_SIZE), law, 0, 0)
        super().__init__(simulation, params.controller, world)

    def prepare(self, trial: plant.Trial) -> PlantWorld:
        """Return the world, before the release of a trial."""
        simulation = self.simulation
        self.pendulum = plant.scaled(simulation.pendulum, trial.variation)
        self.zero = trial.variation.zero if self.params.has_sensor else None
        return self._world._replace(seed=simulation.seed, stream=simulation.stream)

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        q = self._batch.arm.q if self.params.has_sensor else self.controller.q
        return self.simulation.setup.arm.with_held(q[:, 0])
