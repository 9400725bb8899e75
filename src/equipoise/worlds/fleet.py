"""Fleets of closed loops that advance together, a tick at a time, for vector environments.

A fleet keeps the newest values of all its loops in arrays, one row each. On the plant of the
training, loops run in batches of `BATCH_SIZE` lanes, and one compiled call advances all of them; on
a twin each loop advances separately. A loop gives the same bits as a single one
(`equipoise.worlds.interface.ClosedLoop`).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numba.typed import List

from equipoise.control.control_step import EST_PHI, EST_PHI_DOT, EST_PIVOT_V, EST_X
from equipoise.control.grid import TRUNCATED
from equipoise.errors import InputError
from equipoise.jit import kernel, struct_ref
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.worlds.ideal import PlantSimulation, advance_lanes, new_lanes, place_trial
from equipoise.worlds.interface import Array, ClosedLoop, Simulation, estimated, predicted
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
    encoder: Array
    """Encoder counts from hanging, and their age [s], shape (n, 2); zeros without an encoder."""
    measured: Array
    """Measured free joints [rad], and their age [s], shape (n, 7); zeros without an encoder."""
    cause: IntArray
    """Cause of the failure in the last step, `TRUNCATED` without one, shape (n,)."""
    tick: IntArray
    """Number of steps since the release, shape (n,)."""


def new_loop_arrays(count: int) -> LoopArrays:
    """Return arrays for `count` loops."""
    predicted, estimated, state = np.zeros((3, count, 4))
    encoder, measured = np.zeros((count, 2)), np.zeros((count, FREE_JOINTS + 1))
    cause, tick = np.full(count, TRUNCATED, np.int64), np.zeros(count, np.int64)
    return LoopArrays(predicted, estimated, state, encoder, measured, cause, tick)


class Fleet(ABC):
    """Closed loops that advance together."""

    def __init__(self, count: int, threads: int) -> None:
        """Allocate the values, and start the threads.

        Args:
            count: Number of loops.
            threads: Number of threads besides the caller's.
        """
        self.values = new_loop_arrays(count)
        """Newest values of all loops; `reset` and `step` change them in place."""
        self._pool = ThreadPoolExecutor(threads) if threads > 0 else None

    @abstractmethod
    def reset(self, loops: IntArray, trials: Trials) -> None:
        """Release the pendulums of some loops.

        Args:
            loops: Indices of the loops, shape (m,).
            trials: Conditions, m rows.
        """

    @abstractmethod
    def step(self, u: Array) -> None:
        """Advance all loops by one tick.

        Args:
            u: Acceleration of each flange along x [m/s^2], shape (n,).
        """

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()


def new_fleet(simulation: Simulation, count: int, workers: int) -> Fleet:
    """Return a fleet in a simulated world.

    Args:
        simulation: The world.
        count: Number of loops.
        workers: Largest number of threads; the results do not depend on it.

    Raises:
        InputError: The world has fewer loops.
    """
    if count > simulation.MOST_LOOPS:
        raise InputError(
            f"{count} environments at once, and this world has {simulation.MOST_LOOPS}; start as "
            "many of it, or take another world"
        )
    if isinstance(simulation, PlantSimulation):
        return PlantFleet(simulation, count, workers)
    return LoopFleet([simulation.loop() for _ in range(count)], workers)


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
        values.encoder[loop, 0] = at(controller.counts, 0, n)
        for i in range(FREE_JOINTS):
            values.measured[loop, i] = at(controller.measured, i, n)
    else:
        for i in range(4):
            values.estimated[loop, i] = values.predicted[loop, i]


class PlantFleet(Fleet):
    """A fleet on the plant of the training."""

    def __init__(self, simulation: PlantSimulation, count: int, workers: int) -> None:
        """Allocate the states; no pendulum is released yet."""
        number = -(-count // BATCH_SIZE)
        threads = max(1, min(workers, number // BATCHES_PER_THREAD))
        super().__init__(count, threads - 1)
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
        """Release the pendulums of some loops; see `Fleet.reset`."""
        self._key[:] = self._simulation.seed, self._simulation.stream
        reset_loops(self._handle, loops, trials)

    def step(self, u: Array) -> None:
        """Advance all loops by one tick; see `Fleet.step`."""
        if self._pool is None:
            step_batches(self._handle, *self._first, u)
            return
        others = [self._pool.submit(step_batches, self._handle, *ends, u) for ends in self._pieces]
        step_batches(self._handle, *self._first, u)
        for other in others:
            other.result()


class LoopFleet(Fleet):
    """A fleet of closed loops, each advanced by itself."""

    def __init__(self, loops: Sequence[ClosedLoop], workers: int) -> None:
        """Take the loops; no pendulum is released yet."""
        threads = min(workers, len(loops))
        super().__init__(len(loops), threads if threads > 1 else 0)
        self._loops = loops
        self._pieces = [range(first, len(loops), threads) for first in range(threads)]

    def reset(self, loops: IntArray, trials: Trials) -> None:
        """Release the pendulums of some loops; see `Fleet.reset`."""
        for row, loop in enumerate(loops.tolist()):
            self._loops[loop].reset(trials.trial(row))
            self.values.tick[loop] = -1
            self._read(loop, TRUNCATED)

    def step(self, u: Array) -> None:
        """Advance all loops by one tick; see `Fleet.step`."""

        def step(piece: range) -> None:
            for loop in piece:
                self._read(loop, self._loops[loop].step(float(u[loop])))

        if self._pool is None:
            step(self._pieces[0])
        else:
            list(self._pool.map(step, self._pieces))

    def _read(self, loop: int, cause: int) -> None:
        values, source = self.values, self._loops[loop]
        values.predicted[loop], values.estimated[loop] = predicted(source), estimated(source)
        values.state[loop] = source.state()
        if (newest := source.measurement()) is not None:
            now = source.now
            values.encoder[loop] = newest.counts, now - newest.counted_at
            values.measured[loop] = *newest.q, now - newest.measured_at
        values.cause[loop] = cause
        values.tick[loop] += 1
