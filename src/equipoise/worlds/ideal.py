"""Trials on the plant of the training: worlds `ideal` and `model`.

With the actuator `ideal` this is the paper's simulation; with any other, the arm follows through
delay, servo and drive, and the controller observes through an encoder.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from equipoise.arrays import Array, IntArray
from equipoise.control.control_step import OBS_PHI, OBS_PHI_DOT, OBS_X, OBS_X_DOT
from equipoise.control.grid import TRUNCATED
from equipoise.control.policy import RANDOM, TABLE, PolicyKernel, act, table_action
from equipoise.errors import SettingsError
from equipoise.jit import called, kernel, struct_ref
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import philox, uniform
from equipoise.model.worlds import IDEAL, MODEL, World
from equipoise.worlds.interface import ClosedLoop, Setup, Simulation
from equipoise.worlds.plant import (
    TRACKED,
    BatchState,
    DomainRandomization,
    LoopParams,
    X,
    copy_lane,
    draw_noise,
    make_loop_params,
    measure,
    new_batch_state,
    reset,
    scaled,
    step,
)
from equipoise.worlds.trials import Trial, Trials

Lanes: Any = struct_ref("Lanes", __name__, ("plant", "pendulum", "batch", "number", "tick", "key"))


@kernel
def new_lanes(
    plant: LoopParams,
    pendulum: PendulumParameters,
    batch: BatchState,
    number: IntArray,
    tick: IntArray,
    key: IntArray,
) -> Any:
    """Return a batch of closed loops that kernels take by reference.

    Args:
        plant: Constants.
        pendulum: Nominal parameters, which the factors of each trial scale.
        batch: States.
        number: Number of the trial in each lane, shape (BATCH_SIZE,).
        tick: Number of steps of each lane, shape (BATCH_SIZE,).
        key: Seed and stream of the noise, shape (2,).
    """
    return Lanes(plant, pendulum, batch, number, tick, key)


@kernel
def advance_lanes(lanes: Any, count: int) -> None:
    """Advance the first lanes by one tick, with the u of each in its controller."""
    batch, key = lanes.batch, lanes.key
    draw_noise(batch.controller.noise, key[0], lanes.tick, lanes.number, 0, key[1], count)
    step(lanes.plant, batch, count)
    for n in range(count):
        lanes.tick[n] += 1


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

    def run_piece(
        self, policy: PolicyKernel, trials: Trials, rows: Sequence[int], duration: float
    ) -> None:
        """Run trials of a compiled policy in this thread; see `Simulation.run`."""
        plant, taken = self.params, np.array(rows, np.int64)
        batch, max_steps = new_batch_state(), round(duration / plant.controller.h)
        keys = self.seed, self.stream
        run_trials(plant, batch, policy, self.pendulum, trials, taken, max_steps, *keys)


class IdealSimulation(PlantSimulation):
    """Trials on the paper's plant."""

    ideal_arm: ClassVar[bool] = True


class PlantLoop(ClosedLoop):
    """Closed loop of the training, in the first lane of a batch."""

    def __init__(self, simulation: PlantSimulation) -> None:
        """Allocate the state."""
        self._simulation, self._plant, batch = simulation, simulation.params, new_batch_state()
        self._batch, self._key = batch, np.zeros(2, np.int64)
        self._number, self._tick = np.zeros((2, BATCH_SIZE), np.int64)
        self._lanes = new_lanes(
            self._plant, simulation.pendulum, batch, self._number, self._tick, self._key
        )
        self.params, self.controller = self._plant.controller, batch.controller
        self.pendulum = simulation.pendulum

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        own, nominal, batch = trial.variation, self._simulation.pendulum, self._batch
        self._number[0], self._tick[0], self.now, self.tracked = trial.number, 0, 0.0, 0.0
        self._key[:] = self._simulation.seed, self._simulation.stream
        self.pendulum = scaled(nominal, own.inertia_factor, own.friction_factor)
        reset(self._plant, batch, nominal, own, trial.start, 0)
        if self.params.has_sensor:
            self.zero = own.zero
            measure(self.params, batch, 1)

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        self.controller.u[0] = u
        advance_lanes(self._lanes, 1)
        self.now = float(self._tick[0]) * self.params.h
        self.tracked = float(self._batch.state[TRACKED * BATCH_SIZE])
        return int(self._batch.cause[0])

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return self._batch.state[: 4 * BATCH_SIZE : BATCH_SIZE].copy()

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        q = self._batch.q if self.params.has_sensor else self._batch.controller.q
        return self._simulation.setup.arm.with_held(q[::BATCH_SIZE])


@called
def place_trial(
    plant: LoopParams,
    batch: BatchState,
    pendulum: PendulumParameters,
    trials: Trials,
    row: int,
    n: int,
) -> None:
    """Place the trial of a row in lane `n`."""
    x, x_dot, phi, phi_dot = trials.start[row]
    inertia, friction, delay, lag, zero = trials.variation[row]
    variation = DomainRandomization(inertia, friction, delay, lag, zero)
    reset(plant, batch, pendulum, variation, (x, x_dot, phi, phi_dot), n)


@kernel
def run_trials(
    plant: LoopParams,
    batch: BatchState,
    policy: PolicyKernel,
    pendulum: PendulumParameters,
    trials: Trials,
    rows: IntArray,
    max_steps: int,
    seed: int,
    stream: int,
) -> None:
    """Run trials in all lanes of a batch, and write their results.

    Args:
        plant: Constants.
        batch: Scratch space for the states.
        policy: The policy; with several tables, each row has the index of its own.
        pendulum: Nominal parameters, which the factors of each trial scale.
        trials: Conditions; receives the results.
        rows: Rows of the trials to run.
        max_steps: Number of steps after which a trial is truncated.
        seed: Seed of the noise.
        stream: Stream of the noise: selection or test.
    """
    controller, cause = batch.controller, batch.cause
    observation, u = controller.observation, controller.u
    row = np.zeros(BATCH_SIZE, np.int64)
    number = np.zeros(BATCH_SIZE, np.int64)
    tick = np.zeros(BATCH_SIZE, np.int64)
    sum_x2 = np.zeros(BATCH_SIZE)
    placed = 0
    lanes = 0
    while lanes < BATCH_SIZE and placed < len(rows):
        row[lanes], number[lanes] = rows[placed], trials.number[rows[placed]]
        place_trial(plant, batch, pendulum, trials, rows[placed], lanes)
        placed += 1
        lanes += 1
    while lanes > 0:
        for n in range(lanes):
            x, x_dot = at(observation, OBS_X, n), at(observation, OBS_X_DOT, n)
            phi, phi_dot = at(observation, OBS_PHI, n), at(observation, OBS_PHI_DOT, n)
            if policy.kind == TABLE:
                u[n] = table_action(policy, int(trials.table[row[n]]), x, x_dot, phi, phi_dot)
                continue
            chance = 0.0
            if policy.kind == RANDOM:
                chance = uniform(philox(seed, tick[n], number[n], 1, stream)[0], 0.0, 1.0)
            u[n] = act(policy, x, x_dot, phi, phi_dot, chance)
        draw_noise(controller.noise, seed, tick, number, 0, stream, lanes)
        step(plant, batch, lanes)
        for n in range(lanes - 1, -1, -1):
            tick[n] += 1
            sum_x2[n] += at(batch.state, X, n) ** 2
            if cause[n] == TRUNCATED and tick[n] < max_steps:
                continue
            i = row[n]
            trials.steps[i], trials.cause[i], trials.sum_x2[i] = tick[n], cause[n], sum_x2[n]
            for j in range(4):
                trials.end[i, j] = at(batch.state, j, n)
            if placed < len(rows):
                row[n], number[n] = rows[placed], trials.number[rows[placed]]
                tick[n], sum_x2[n] = 0, 0.0
                place_trial(plant, batch, pendulum, trials, rows[placed], n)
                placed += 1
            else:
                lanes -= 1
                copy_lane(batch, lanes, n)
                row[n], number[n] = row[lanes], number[lanes]
                tick[n], sum_x2[n] = tick[lanes], sum_x2[lanes]
