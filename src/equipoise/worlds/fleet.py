"""Closed loops on the plant that advance together, a tick at a time, for vector environments.

A fleet keeps the newest values of all its loops in arrays, one row each. Loops run in batches of
`BATCH_SIZE` lanes, and one compiled call advances all of them. A loop gives the same bits as a
single one (`equipoise.worlds.ideal.PlantLoop`).
"""

from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numba.typed import List

from equipoise.control.control_step import EST_PHI, EST_PHI_DOT, EST_PIVOT_V, EST_X
from equipoise.control.grid import TRUNCATED
from equipoise.jit import kernel, struct_ref
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.worlds.ideal import PlantSimulation, advance_lanes, new_lanes, place_trial
from equipoise.worlds.interface import Array
from equipoise.worlds.plant import measure, new_batch_state
from equipoise.worlds.trials import IntArray, Trials

BATCHES_PER_THREAD: Final = 16
"""Minimum number of batches per thread: starting a thread takes as long as one batch."""


class LoopArrays(NamedTuple):
    """Values of n closed loops at a tick, one row each."""

    predicted: Array
    """x, x_dot, phi, phi_dot at which u takes effect, shape (n, 4)."""
    estimated: Array
    """Estimate of x, x_dot, phi, phi_dot at the tick, shape (n, 4)."""
    state: Array
    """True x, x_dot, phi, phi_dot at the tick, shape (n, 4)."""
    cause: IntArray
    """Cause of the failure in the last step, `TRUNCATED` without one, shape (n,)."""
    tick: IntArray
    """Number of steps since the release, shape (n,)."""


def new_loop_arrays(count: int) -> LoopArrays:
    """Return arrays for `count` loops."""
    predicted, estimated, state = np.zeros((3, count, 4))
    cause, tick = np.full(count, TRUNCATED, np.int64), np.zeros(count, np.int64)
    return LoopArrays(predicted, estimated, state, cause, tick)


FleetHandle: Any = struct_ref("FleetHandle", __name__, ("batches", "values"))


@kernel
def new_fleet_handle(batches: Any, values: LoopArrays) -> Any:
    """Return a fleet that kernels take by reference."""
    return FleetHandle(batches, values)


@kernel
def new_batches(lanes: Any) -> Any:
    """Return a list of one batch of lanes."""
    batches: Any = List()  # pyright: ignore[reportCallIssue]  # a class, not a module
    batches.append(lanes)
    return batches


@kernel
def append_batch(batches: Any, lanes: Any) -> Any:
    """Append a batch of lanes to a list, and return the list."""
    batches.append(lanes)
    return batches


@kernel
def reset_loops(fleet: Any, loops: IntArray, trials: Trials) -> None:
    """Release the pendulums of some loops, and read their values."""
    for row in range(len(loops)):
        lanes, n = fleet.batches[loops[row] // BATCH_SIZE], loops[row] % BATCH_SIZE
        place_trial(lanes.plant, lanes.batch, lanes.pendulum, trials, row, n)
        lanes.number[n], lanes.tick[n] = trials.number[row], 0
        if lanes.plant.controller.has_sensor:
            # The other lanes are measured again, to the same values.
            measure(lanes.plant.controller, lanes.batch, BATCH_SIZE)
        read_lane(fleet.values, lanes, loops[row], n)


@kernel
def step_batches(fleet: Any, first: int, last: int, u: Array) -> None:
    """Advance the loops of the batches first <= b < last by one tick, and read their values."""
    for b in range(first, last):
        lanes, start = fleet.batches[b], b * BATCH_SIZE
        count = min(len(u) - start, BATCH_SIZE)
        for n in range(count):
            lanes.batch.controller.u[n] = u[start + n]
        advance_lanes(lanes, count)
        for n in range(count):
            read_lane(fleet.values, lanes, start + n, n)


@kernel
def read_lane(values: LoopArrays, lanes: Any, loop: int, n: int) -> None:
    """Copy the newest values of lane `n` to the row of its loop."""
    batch, controller = lanes.batch, lanes.batch.controller
    for i in range(4):
        values.predicted[loop, i] = at(controller.observation, i, n)
        values.state[loop, i] = at(batch.state, i, n)
    values.cause[loop], values.tick[loop] = batch.cause[n], lanes.tick[n]
    if lanes.plant.controller.has_sensor:
        values.estimated[loop, 0] = at(controller.estimate, EST_X, n)
        values.estimated[loop, 1] = at(controller.estimate, EST_PIVOT_V, n)
        values.estimated[loop, 2] = at(controller.estimate, EST_PHI, n)
        values.estimated[loop, 3] = at(controller.estimate, EST_PHI_DOT, n)
    else:
        for i in range(4):
            values.estimated[loop, i] = values.predicted[loop, i]


class Fleet:
    """Closed loops on the plant of the training that advance together."""

    def __init__(self, simulation: PlantSimulation, count: int, workers: int) -> None:
        """Allocate the states, and start the threads; no pendulum is released yet.

        Args:
            simulation: The plant.
            count: Number of loops.
            workers: Largest number of threads; the results do not depend on it.
        """
        number = -(-count // BATCH_SIZE)
        threads = max(1, min(workers, number // BATCHES_PER_THREAD))
        self.values = new_loop_arrays(count)
        """Newest values of all loops; `reset` and `step` change them in place."""
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self._simulation, self._key = simulation, np.zeros(2, np.int64)
        model, batches = (simulation.params, simulation.pendulum), None
        for _ in range(number):
            numbers, ticks = np.zeros((2, BATCH_SIZE), np.int64)
            lanes = new_lanes(*model, new_batch_state(), numbers, ticks, self._key)
            batches = new_batches(lanes) if batches is None else append_batch(batches, lanes)
        self._handle = new_fleet_handle(batches, self.values)
        ends: list[int] = np.linspace(0, number, threads + 1).round().astype(int).tolist()
        self._first, *self._pieces = pairwise(ends)

    def reset(self, loops: IntArray, trials: Trials) -> None:
        """Release the pendulums of some loops.

        Args:
            loops: Indices of the loops, shape (m,).
            trials: Conditions, m rows.
        """
        self._key[:] = self._simulation.seed, self._simulation.stream
        reset_loops(self._handle, loops, trials)

    def step(self, u: Array) -> None:
        """Advance all loops by one tick.

        Args:
            u: Acceleration of each flange along x [m/s^2], shape (n,).
        """
        others: list[Future[None]] = []
        if self._pool is not None:
            submit = self._pool.submit
            others = [submit(step_batches, self._handle, *ends, u) for ends in self._pieces]
        step_batches(self._handle, *self._first, u)
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
