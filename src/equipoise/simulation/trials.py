"""Conditions of trials, drawn before the trials run, and their results.

The conditions of trial i depend on the seed and i alone: not on the number of trials, of workers,
or on the policy, so that policies are compared on the same trials.
"""

from math import pi
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from equipoise.arrays import Array, IntArray
from equipoise.control.policy import RANDOM, PolicyKernel, act
from equipoise.control.swing_up import begin_swing_up, time_limit
from equipoise.jit import Kernel, call, kernel
from equipoise.model.grid import NOT_UPRIGHT, TRUNCATED
from equipoise.model.random import philox, uniform
from equipoise.settings import HANGING, Settings
from equipoise.simulation.plant import Trial, copy_lane, observed, trial_of


class Trials(NamedTuple):
    """Conditions and results of n trials, one row each."""

    number: IntArray
    """Number of each trial, shape (n,)."""
    start: Array
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release, shape (n, 4)."""
    variation: Array
    """Fields of `DomainRandomization`, shape (n, 5)."""
    steps: IntArray
    """Result: number of steps, shape (n,)."""
    cause: IntArray
    """Result: cause of the end, shape (n,)."""
    sum_x2: Array
    """Result: sum of x^2 over the steps [m^2], shape (n,)."""
    upright: IntArray
    """Result: number of steps of the swing-up, which are none of `steps`, shape (n,)."""
    end: Array
    """Result: true x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the end, shape (n, 4)."""

    def parts(self, size: int) -> list["Trials"]:
        """Return parts of `size` trials, whose arrays are views."""
        firsts = range(0, len(self.number), size)
        return [Trials._make(column[i : i + size] for column in self) for i in firsts]

    def trial(self, row: int) -> Trial:
        """Return the conditions in one row."""
        number, start, variation, *_ = (column[row].tolist() for column in self)
        return trial_of(number, start, variation)


def draw_trials(count: int, settings: Settings, seed: int, stream: int, first: int = 0) -> Trials:
    """Draw the conditions of trials: starts as after a release by hand, and varied plants.

    Args:
        count: Number of trials.
        settings: Ranges of the start, standard deviations of I and b.
        seed: Master seed.
        stream: Purpose of the trials, such as selection or test.
        first: Number of the first trial.
    """

    def uniform(columns: int, *key: int) -> Array:
        generator = np.random.PCG64([seed, stream, *key])
        return np.random.Generator(generator.advance(columns * first)).random((count, columns))

    e, plant = settings.evaluation, settings.plant
    draws = uniform(5)
    rig = 2.0 * uniform(3, 1) - 1.0
    sign = np.where(draws[:, 0] < 0.5, -1.0, 1.0)
    start = np.zeros((count, 4))
    start[:, 2] = sign * (e.phi_low + (e.phi_high - e.phi_low) * draws[:, 1])
    start[:, 3] = sign * (e.phi_dot_low + (e.phi_dot_high - e.phi_dot_low) * draws[:, 2])
    if e.start == HANGING:
        start[:, 2] = sign * pi - start[:, 2]
    variation = [  # the fields of `DomainRandomization`
        1.0 + plant.inertia_sigma * ndtri(draws[:, 3]),
        1.0 + plant.friction_sigma * ndtri(draws[:, 4]),
        plant.delay_spread * rig[:, 0],
        1.0 + plant.lag_spread * rig[:, 1],
        plant.zero_error * rig[:, 2],
    ]
    conditions = np.arange(first, first + count), start, np.column_stack(variation)
    steps, cause, upright = np.zeros((3, count), np.int64)
    return Trials(*conditions, steps, cause, np.zeros(count), upright, np.zeros((count, 4)))


class WorldKernels(NamedTuple):
    """Functions of a world of compiled trials."""

    place: Kernel
    """Places a lane at the start of a trial, from a kernel: `place(world, trial, n)`."""
    advance: Kernel
    """Advances the first lanes by a step, likewise: `advance(world, seed, tick, number, lanes)`,
    all but the world and the number of lanes as arrays."""
    place_alone: Kernel
    """The same, compiled, from Python."""
    advance_alone: Kernel
    """The same, compiled, from Python."""
    run_trials: Kernel
    """Runs trials side by side: `run_trials(world, policy, trials, max_steps)`."""


def kernels_of(place: Kernel, advance: Kernel) -> WorldKernels:
    """Return the kernels of a world from two of its functions; see `WorldKernels`."""

    def run_trials(world: Any, policy: PolicyKernel, trials: Trials, max_steps: int) -> None:
        """Run trials side by side, and write their results.

        Args:
            world: Its `states` hold a record with `controller`, `state` and `cause`; its `swing_up`
                brings up the pendulums that hang at the start.
            policy: The policy.
            trials: Conditions; receives the results.
            max_steps: Number of steps after which a trial is truncated.
        """
        batch, law = world.states[0], world.swing_up
        state, seen, u = batch.state, batch.controller.observation, batch.controller.u
        swings = batch.swing_up
        balancing, swing_steps = batch.controller.balancing, round(time_limit(law.pendulum) / law.h)
        row = np.zeros(world.batch_size, np.int64)
        seed = np.full(world.batch_size, world.seed)
        number = np.zeros(world.batch_size, np.int64)
        tick = np.zeros(world.batch_size, np.int64)
        upright = np.zeros(world.batch_size, np.int64)
        sum_x2 = np.zeros(world.batch_size)
        placed, lanes, count = 0, 0, len(trials.number)

        def begin(n: int) -> None:
            row[n], number[n] = placed, trials.number[placed]
            tick[n], upright[n], sum_x2[n] = 0, 0, 0.0
            place(world, trial_of(number[n], trials.start[placed], trials.variation[placed]), n)
            begin_swing_up(law, swings, n)

        while lanes < world.batch_size and placed < count:
            begin(lanes)
            placed += 1
            lanes += 1
        while lanes > 0:
            for n in range(lanes):
                chance = 0.0
                if policy.kind == RANDOM:
                    words = philox(world.seed, tick[n], number[n], 1, world.stream)
                    chance = uniform(words[0], 0.0, 1.0)
                observation = observed(seen, n)
                if balancing[n] == 0:
                    call(law.swing_up, (law, swings, policy, observation, n))
                    balancing[n] = swings.ended[n]
                if balancing[n] != 0:
                    u[n] = act(policy, observation, chance)
                else:
                    u[n] = swings.u[n]
            advance(world, seed, tick, number, lanes)
            for n in range(lanes - 1, -1, -1):
                tick[n] += 1
                if balancing[n] == 0:
                    upright[n] = tick[n]
                    if batch.cause[n] == TRUNCATED and tick[n] >= swing_steps:
                        batch.cause[n] = NOT_UPRIGHT
                else:
                    sum_x2[n] += state.x[n] ** 2
                steps = tick[n] - upright[n]
                if batch.cause[n] == TRUNCATED and steps < max_steps:
                    continue
                i = row[n]
                trials.steps[i], trials.upright[i] = steps, upright[n]
                trials.cause[i], trials.sum_x2[i] = batch.cause[n], sum_x2[n]
                trials.end[i, 0], trials.end[i, 1] = state.x[n], state.x_dot[n]
                trials.end[i, 2], trials.end[i, 3] = state.phi[n], state.phi_dot[n]
                if placed < count:
                    begin(n)
                    placed += 1
                    continue
                lanes -= 1
                copy_lane(world.rows, lanes, n)
                row[n], number[n] = row[lanes], number[lanes]
                tick[n], upright[n], sum_x2[n] = tick[lanes], upright[lanes], sum_x2[lanes]

    return WorldKernels(place, advance, kernel(place), kernel(advance), kernel(run_trials))
