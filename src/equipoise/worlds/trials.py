"""Conditions of trials, drawn before the trials run, and their results.

The conditions of trial i depend on the seed and i alone: not on the number of trials, of workers,
or on the policy, so that policies are compared on the same trials.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from equipoise.arrays import Array, IntArray
from equipoise.settings import Settings
from equipoise.worlds.plant import DomainRandomization


class Trial(NamedTuple):
    """Conditions of one trial."""

    number: int
    """Number of the trial, which determines all noise together with the seed."""
    start: tuple[float, float, float, float]
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release."""
    variation: DomainRandomization
    """Difference of the plant from the nominal one."""


class Trials(NamedTuple):
    """Conditions and results of n trials, one row each."""

    number: IntArray
    """Number of each trial, shape (n,)."""
    start: Array
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release, shape (n, 4)."""
    variation: Array
    """Fields of `DomainRandomization`, shape (n, 5)."""
    table: IntArray
    """Index of the table among those of the policy, shape (n,); for several tables."""
    steps: IntArray
    """Result: number of steps, shape (n,)."""
    cause: IntArray
    """Result: cause of the end, shape (n,)."""
    sum_x2: Array
    """Result: sum of x^2 over the steps [m^2], shape (n,)."""
    end: Array
    """Result: true x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the end, shape (n, 4)."""

    def trial(self, row: int) -> Trial:
        """Return the conditions in one row."""
        x, x_dot, phi, phi_dot = self.start[row].tolist()
        variation = DomainRandomization(*self.variation[row].tolist())
        return Trial(int(self.number[row]), (x, x_dot, phi, phi_dot), variation)

    def of_tables(self, tables: Sequence[int]) -> "Trials":
        """Return these trials for each of several tables, one table after the other.

        Args:
            tables: Index of each table among those of the policy.
        """
        count = len(self.number)
        columns: Any = [np.concatenate([values] * len(tables)) for values in self]
        return Trials(*columns)._replace(table=np.repeat(tables, count))


def draw_trials(
    count: int, settings: Settings, seed: int, stream: int, spread: float, first: int = 0
) -> Trials:
    """Draw the conditions of trials: starts as after a release by hand, and varied plants.

    Args:
        count: Number of trials.
        settings: Ranges of the start, standard deviations of I and b.
        seed: Master seed.
        stream: Purpose of the trials, such as selection or test.
        spread: Factor on the variation of the plants.
        first: Number of the first trial.
    """

    def uniform(columns: int, *key: int) -> Array:
        generator = np.random.PCG64([seed, stream, *key])
        return np.random.Generator(generator.advance(columns * first)).random((count, columns))

    e, plant = settings.evaluation, settings.plant
    draws = uniform(5)
    rig = spread * (2.0 * uniform(3, 1) - 1.0)
    sign = np.where(draws[:, 0] < 0.5, -1.0, 1.0)
    start = np.zeros((count, 4))
    start[:, 2] = sign * (e.phi_low + (e.phi_high - e.phi_low) * draws[:, 1])
    start[:, 3] = sign * (e.phi_dot_low + (e.phi_dot_high - e.phi_dot_low) * draws[:, 2])
    variation = [  # the fields of `DomainRandomization`
        1.0 + spread * plant.inertia_sigma * ndtri(draws[:, 3]),
        1.0 + spread * plant.friction_sigma * ndtri(draws[:, 4]),
        plant.delay_spread * rig[:, 0],
        1.0 + plant.lag_spread * rig[:, 1],
        plant.zero_error * rig[:, 2],
    ]
    return Trials(
        number=np.arange(first, first + count),
        start=start,
        variation=np.column_stack(variation),
        table=np.zeros(count, np.int64),
        steps=np.zeros(count, np.int64),
        cause=np.zeros(count, np.int64),
        sum_x2=np.zeros(count),
        end=np.zeros((count, 4)),
    )
