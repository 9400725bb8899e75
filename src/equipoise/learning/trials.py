"""Trials of a policy: their conditions, drawn before they run, and running them over the cores.

The conditions of trial i depend on the seed and i alone: not on the number of trials, of workers,
or on the policy, so that policies are compared on the same trials.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.special import ndtri

from equipoise.control.policy import PolicyKernel
from equipoise.learning.closed_loop import Plant, Trials, new_block, run_trials
from equipoise.model.elementary import LANES
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import Settings


def draw_trials(count: int, settings: Settings, seed: int, stream: int, spread: float) -> Trials:
    """Draw the conditions of `count` trials: starts as a release leaves them, varied plants.

    Args:
        count: Number of trials.
        settings: Ranges of the start, standard deviations of I and b.
        seed: Master seed.
        stream: Selection or test.
        spread: Factor on the standard deviations of I and b.
    """
    e, plant = settings.evaluation, settings.plant
    draws = np.random.default_rng([seed, stream]).random((count, 5))
    sign = np.where(draws[:, 0] < 0.5, -1.0, 1.0)
    start = np.zeros((count, 4))
    start[:, 2] = sign * (e.phi_low + (e.phi_high - e.phi_low) * draws[:, 1])
    start[:, 3] = sign * (e.phi_dot_low + (e.phi_dot_high - e.phi_dot_low) * draws[:, 2])
    return Trials(
        start=start,
        inertia_factor=1.0 + spread * plant.inertia_sigma * ndtri(draws[:, 3]),
        friction_factor=1.0 + spread * plant.friction_sigma * ndtri(draws[:, 4]),
        steps=np.zeros(count, np.int64),
        cause=np.zeros(count, np.int64),
        sum_x2=np.zeros(count),
    )


def run_over_cores(
    plant: Plant,
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
    longest = round(duration / plant.h)

    def piece(first: int) -> None:
        last = min(first + size, count)
        block = new_block()
        run_trials(plant, block, policy, pendulum, trials, first, last, longest, seed, stream)
        done(last - first)

    size = 4 * LANES
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
