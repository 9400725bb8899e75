"""Closed loops on the plant of the training, for tests that set their lanes one by one."""

import numpy as np

from equipoise.arrays import fields, new_records
from equipoise.jit import call, kernel
from equipoise.simulation.plant import BatchState, DomainRandomization, Trial, scaled

NOMINAL = DomainRandomization(1.0, 1.0, 0.0, 1.0, 0.0)
"""A plant that is as the controller thinks."""


@kernel
def _reset(plant, batches, trial, n):
    call(plant.reset, (plant, batches[0], trial, n))


@kernel
def _step(plant, batches, lanes):
    call(plant.step, (plant, batches[0], lanes))


class Batch:
    """A `BatchState` with its plant."""

    def __init__(self, plant, records=None):
        """Allocate the states, or copy some."""
        self.plant = plant
        self.records = new_records(BatchState) if records is None else records.copy()
        self.state = fields(self.records, BatchState)

    def reset(self, pendulum, variation, start, n=0):
        """See `plant.reset`; the true pendulum need not be a variation of the nominal one."""
        _reset(self.plant, self.records, Trial(0, start, variation), n)
        own = scaled(pendulum, variation)
        pendula = self.state.pendula
        pendula.w2[n], pendula.k[n], pendula.c[n] = own.w2, own.k, own.c
        pendula.coulomb[n], pendula.drag[n] = own.coulomb, own.drag

    def step(self, lanes=1):
        _step(self.plant, self.records, lanes)

    @property
    def controller(self):
        return self.state.controller

    def true(self, lane=slice(None)):
        """Return the true x, x_dot, phi, phi_dot."""
        return rows(self.records["state"], lane)

    def observation(self, lane=slice(None)):
        """Return the observed x, x_dot, phi, phi_dot."""
        return rows(self.records["controller"]["observation"], lane)

    def estimate(self, lane=slice(None)):
        """Return the estimated phi, phi_dot, bias, pivot velocity and x."""
        return rows(self.records["controller"]["estimate"], lane)


def rows(records, lane):
    """Return the numbers of a record of lanes, a row for each field."""
    return np.frombuffer(records[0].tobytes()).reshape(-1, 16)[:, lane]
