"""Trials of a policy: their conditions, drawn before they run, and running them over the cores.

The conditions of trial i depend on the seed and i alone: not on the number of trials, of workers,
or on the policy, so that policies are compared on the same trials.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from equipoise.compiled import kernel
from equipoise.control.boxes import TRUNCATED
from equipoise.control.control_step import OBS_PHI, OBS_PHI_DOT, OBS_X, OBS_X_DOT
from equipoise.control.policy import RANDOM, Policy, PolicyKernel, act
from equipoise.learning.closed_loop import (
    TRACKED,
    BatchState,
    DomainRandomization,
    LoopParams,
    X,
    copy_lane,
    draw_noise,
    new_batch_state,
    reset,
    step,
)
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import philox, uniform
from equipoise.model.sim_configs import TwinSettings
from equipoise.settings import Settings

Array = npt.NDArray[np.float64]


class Trials(NamedTuple):
    """Conditions of n trials, one row each, and what came of them."""

    start: Array
    """x, x_dot, phi, phi_dot, shape (n, 4)."""
    inertia_factor: Array
    """Factor on I, shape (n,)."""
    friction_factor: Array
    """Factor on b, shape (n,)."""
    delay: Array
    """Added to the transport delay [s], shape (n,)."""
    lag_factor: Array
    """Factor on the lags of the joints, shape (n,)."""
    zero: Array
    """What the encoder reads too much of phi [rad], shape (n,)."""
    steps: npt.NDArray[np.int64]
    """How many steps each lasted, shape (n,)."""
    cause: npt.NDArray[np.int64]
    """How each ended, shape (n,)."""
    sum_x2: Array
    """Sum of x^2 over its steps [m^2], shape (n,)."""


def draw_trials(count: int, settings: Settings, seed: int, stream: int, spread: float) -> Trials:
    """Draw the conditions of `count` trials: starts as a release leaves them, varied plants.

    Args:
        count: Number of trials.
        settings: Ranges of the start, standard deviations of I and b.
        seed: Master seed.
        stream: Selection or test.
        spread: Factor on how far plants vary.
    """
    e, plant = settings.evaluation, settings.plant
    draws = np.random.default_rng([seed, stream]).random((count, 5))
    rig = spread * (2.0 * np.random.default_rng([seed, stream, 1]).random((count, 3)) - 1.0)
    sign = np.where(draws[:, 0] < 0.5, -1.0, 1.0)
    start = np.zeros((count, 4))
    start[:, 2] = sign * (e.phi_low + (e.phi_high - e.phi_low) * draws[:, 1])
    start[:, 3] = sign * (e.phi_dot_low + (e.phi_dot_high - e.phi_dot_low) * draws[:, 2])
    return Trials(
        start=start,
        inertia_factor=1.0 + spread * plant.inertia_sigma * ndtri(draws[:, 3]),
        friction_factor=1.0 + spread * plant.friction_sigma * ndtri(draws[:, 4]),
        delay=plant.delay_spread * rig[:, 0],
        lag_factor=1.0 + plant.lag_spread * rig[:, 1],
        zero=plant.zero_error * rig[:, 2],
        steps=np.zeros(count, np.int64),
        cause=np.zeros(count, np.int64),
        sum_x2=np.zeros(count),
    )


def twin_settings(settings: Settings, world: TwinSettings) -> Settings:
    """Return settings whose trials differ as those of a twin do: in I and b as its numbers say.

    Jitter, noise and the error of the encoder's zero are the twin's own.
    """
    sigmas = {"inertia_sigma": world.inertia_sigma, "friction_sigma": world.friction_sigma}
    plant = settings.plant.model_copy(update=sigmas)
    return settings.model_copy(update={"plant": plant})


def run_over_cores(
    plant: LoopParams,
    policy: PolicyKernel,
    pendulum: PendulumParameters,
    trials: Trials,
    *,
    duration: float,
    seed: int,
    stream: int,
    workers: int,
    done: Callable[[int], None] = lambda _: None,
) -> None:
    """Run all trials, in pieces on `workers` threads, and write what came of them.

    Args:
        plant: Constants of the closed loop.
        policy: What decides.
        pendulum: The centre that the factors of each trial scale.
        trials: Conditions, and arrays that are written.
        duration: Length of a trial [s].
        seed: Seed of the noise.
        stream: Stream of the noise.
        workers: Number of threads; the results do not depend on it.
        done: Called with the number of trials of each piece that is finished.
    """
    count = len(trials.steps)
    longest = round(duration / plant.controller.h)

    def piece(first: int) -> None:
        last = min(first + size, count)
        block = new_batch_state()
        run_trials(plant, block, policy, pendulum, trials, first, last, longest, seed, stream)
        done(last - first)

    size = 4 * BATCH_SIZE
    if workers == 1:
        for first in range(0, count, size):
            piece(first)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(piece, range(0, count, size)))


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@kernel
def place_trial(
    plant: LoopParams,
    block: BatchState,
    pendulum: PendulumParameters,
    trials: Trials,
    i: int,
    n: int,
) -> None:
    """Place trial `i` in lane `n`."""
    x, x_dot, phi, phi_dot = trials.start[i]
    variation = DomainRandomization(
        trials.inertia_factor[i],
        trials.friction_factor[i],
        trials.delay[i],
        trials.lag_factor[i],
        trials.zero[i],
    )
    reset(plant, block, pendulum, variation, (x, x_dot, phi, phi_dot), n)


@kernel
def run_trials(
    plant: LoopParams,
    block: BatchState,
    policy: PolicyKernel,
    pendulum: PendulumParameters,
    trials: Trials,
    first: int,
    last: int,
    max_steps: int,
    seed: int,
    stream: int,
) -> None:
    """Run the trials first <= i < last and write what came of them.

    Args:
        plant: Constants.
        block: Room for the states.
        policy: What decides.
        pendulum: The centre that the factors of each trial scale.
        trials: Conditions, and arrays that are written.
        first: First trial.
        last: One past the last trial.
        max_steps: Number of steps after which a trial has lasted.
        seed: Seed of the noise.
        stream: Stream of the noise: selection or test.
    """
    memory, cause = block.controller, block.cause
    seen, u = memory.observation, memory.u
    index = np.zeros(BATCH_SIZE, np.int64)
    tick = np.zeros(BATCH_SIZE, np.int64)
    sum_x2 = np.zeros(BATCH_SIZE)
    waiting = first
    lanes = 0
    while lanes < BATCH_SIZE and waiting < last:
        index[lanes] = waiting
        place_trial(plant, block, pendulum, trials, waiting, lanes)
        waiting += 1
        lanes += 1
    while lanes > 0:
        for n in range(lanes):
            chance = 0.0
            if policy.kind == RANDOM:
                chance = uniform(philox(seed, tick[n], index[n], 1, stream)[0], 0.0, 1.0)
            u[n] = act(
                policy,
                at(seen, OBS_X, n),
                at(seen, OBS_X_DOT, n),
                at(seen, OBS_PHI, n),
                at(seen, OBS_PHI_DOT, n),
                chance,
            )
        draw_noise(memory.noise, seed, tick, index, 0, stream, lanes)
        step(plant, block, lanes)
        for n in range(lanes - 1, -1, -1):
            tick[n] += 1
            sum_x2[n] += at(block.state, X, n) ** 2
            if cause[n] == TRUNCATED and tick[n] < max_steps:
                continue
            i = index[n]
            trials.steps[i], trials.cause[i], trials.sum_x2[i] = tick[n], cause[n], sum_x2[n]
            if waiting < last:
                index[n], tick[n], sum_x2[n] = waiting, 0, 0.0
                place_trial(plant, block, pendulum, trials, waiting, n)
                waiting += 1
            else:
                lanes -= 1
                copy_lane(block, lanes, n)
                index[n], tick[n], sum_x2[n] = index[lanes], tick[lanes], sum_x2[lanes]


class TrialRecording(NamedTuple):
    """What one recorded run went through, a row per step."""

    observation: Array
    """x, x_dot, phi, phi_dot as the policy saw them before the step, shape (n, 4)."""
    state: Array
    """The same as they were, shape (n, 4)."""
    u: Array
    """Commanded acceleration [m/s^2], shape (n,)."""
    tracked: Array
    """Tracked acceleration u' [m/s^2], shape (n,)."""
    estimate: Array
    """Estimated phi [rad], phi_dot [rad/s] and bias of phi [rad] at the step, shape (n, 3)."""
    q: Array
    """Commanded free joints at the end of the step [rad], shape (n, 6)."""
    dq: Array
    """Their velocities [rad/s], shape (n, 6)."""
    arm_q: Array
    """Free joints of the arm at the end of the step [rad], shape (n, 6)."""


def record_trial(
    plant: LoopParams,
    policy: Policy,
    pendulum: PendulumParameters,
    trials: Trials,
    i: int,
    max_steps: int,
    seed: int,
    stream: int,
) -> tuple[int, TrialRecording]:
    """Run one trial with a policy written in Python, `policy.act(state) -> u`, and record it.

    It is the loop of `run_trials`, step for step and noise for noise.

    Args:
        plant: Constants.
        policy: Any object that meets `Policy`.
        pendulum: The centre that the factors of the trial scale.
        trials: Conditions.
        i: Which trial.
        max_steps: Number of steps after which the trial has lasted.
        seed: Seed of the noise.
        stream: Stream of the noise.

    Returns:
        Cause of the end, and the recording.
    """
    block = new_batch_state()
    memory = block.controller
    place_trial(plant, block, pendulum, trials, i, 0)
    widths = (4, 4, 0, 0, 3, 6, 6, 6)
    rows = TrialRecording(
        *(np.zeros((max_steps, width)) if width else np.zeros(max_steps) for width in widths)
    )
    now, at_index = np.zeros(BATCH_SIZE, np.int64), np.full(BATCH_SIZE, i, np.int64)
    tick = 0
    while tick < max_steps and block.cause[0] == TRUNCATED:
        now[0] = tick
        draw_noise(memory.noise, seed, now, at_index, 0, stream, 1)
        seen = memory.observation[::BATCH_SIZE].copy()
        memory.u[0] = float(policy.act(seen))
        rows.observation[tick], rows.u[tick] = seen, memory.u[0]
        rows.state[tick] = block.state[: 4 * BATCH_SIZE : BATCH_SIZE]
        observes = plant.controller.has_sensor
        rows.estimate[tick, :2] = rows.state[tick, 2:]
        if observes:
            rows.estimate[tick] = memory.estimate[: 3 * BATCH_SIZE : BATCH_SIZE]
        step(plant, block, 1)
        rows.tracked[tick] = block.state[TRACKED * BATCH_SIZE]
        rows.q[tick], rows.dq[tick] = memory.q[::BATCH_SIZE], memory.dq[::BATCH_SIZE]
        rows.arm_q[tick] = block.q[::BATCH_SIZE] if observes else memory.q[::BATCH_SIZE]
        tick += 1
    return int(block.cause[0]), TrialRecording(*(row[:tick] for row in rows))
