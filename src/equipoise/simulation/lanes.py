"""Episodes side by side, a tick at a time: the lanes of a vector environment.

Each lane has a seed of its own, and the bits of a single closed loop with that seed. A world of
compiled trials holds as many lanes as it runs trials side by side. One compiled call advances the
worlds of a thread.
"""

import functools
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Annotated, Any, Final, Protocol

import numpy as np
from numba.typed import List

from equipoise import paper
from equipoise.arrays import Array, IntArray, Records, record_type
from equipoise.control.policy import Observation
from equipoise.errors import InputError
from equipoise.executors import available_cores
from equipoise.files import quoted
from equipoise.jit import Kernel, compilable, kernel
from equipoise.model.grid import TRUNCATED
from equipoise.simulation.interface import Simulation
from equipoise.simulation.plant import observed, trial_of

WINDOW: Final = 32
"""Number of episodes of a lane whose conditions are drawn together."""
WORLDS_AHEAD: Final = 12
"""Number of worlds that the calling thread advances while another one wakes; one wakes for more."""


class Lane(Protocol):
    """Episode of a lane, and the result of its last step."""

    seed: int
    """Master seed."""
    number: int
    """Number of the episode."""
    tick: int
    """Number of its steps."""
    time: float
    """Time since the release [s]."""
    upright: int
    """Number of ticks within the failure angle, after a hanging start."""
    observation: Annotated[Array, (4,)]
    """Predicted x, x_dot, phi, phi_dot, at which the next u takes effect."""
    state: Annotated[Array, (4,)]
    """True x, x_dot, phi, phi_dot."""
    reward: float
    """Reward of the step."""
    cause: int
    """Cause of the failure, `TRUNCATED` without one."""


@compilable
def upright_ticks(before: int, phi: float, h: float) -> tuple[int, bool]:
    """Return for how many ticks a swung-up pendulum has stood, and whether it may fail from now on.

    It may once it has stayed within the failure angle for a second.

    Args:
        before: Number of ticks until now.
        phi: Its angle from upright [rad].
        h: Time between ticks [s].
    """
    ticks = before + 1 if abs(phi) < paper.PHI_LIMIT else 0
    return ticks, ticks * h >= 1.0


@kernel
def listed(world: Any) -> Any:
    """Return a list of one world; kernels take a list by reference, without reading all fields."""
    worlds: Any = List()  # pyright: ignore[reportCallIssue]  # a class, not a module
    worlds.append(world)
    return worlds


@kernel
def append(worlds: Any, world: Any) -> None:
    """Append a world to a list."""
    worlds.append(world)


@functools.cache
def compiled_lanes(
    place: Kernel, advance: Kernel, reward: Kernel, cached: bool
) -> tuple[Kernel, Kernel]:
    """Return the compiled release and step of lanes; see `Lanes`.

    Args:
        place: Places a lane of a world, see `WorldKernels`.
        advance: Advances the first lanes of a world, likewise.
        reward: The reward, callable in kernels.
        cached: Whether its code is cached on disk.
    """

    def release(worlds: Any, lanes: Any, rows: IntArray, start: Array, variation: Array) -> None:
        for k in range(len(rows)):
            lane, (b, n) = lanes[rows[k]], divmod(rows[k], worlds[0].batch_size)
            place(worlds[b], trial_of(lane.number, start[k], variation[k]), n)
            lane.tick, lane.upright, lane.reward, lane.cause = 0, 0, 0.0, TRUNCATED
            read(worlds[b].states[0], lane, n)

    def step(worlds: Any, lanes: Any, h: float, first: int, last: int, u: Array) -> None:
        for b in range(first, last):
            world, begin = worlds[b], b * worlds[b].batch_size
            batch, own = world.states[0], lanes[begin : begin + world.batch_size]
            controller = batch.controller
            for n in range(len(own)):
                controller.u[n] = min(max(u[begin + n], -paper.U_MAX), paper.U_MAX)
            advance(world, own.seed, own.tick, own.number, len(own))
            for n in range(len(own)):
                lane = own[n]
                if controller.balancing[n] == 0:
                    lane.upright, balances = upright_ticks(lane.upright, batch.state.phi[n], h)
                    controller.balancing[n] = balances
                x, x_dot, phi, phi_dot = lane.observation
                before = Observation(x, x_dot, phi, phi_dot)
                after, failed = observed(controller.observation, n), batch.cause[n] != TRUNCATED
                lane.reward = reward(before, controller.u[n], after, failed)
                lane.tick, lane.cause = lane.tick + 1, batch.cause[n]
                read(batch, lane, n)

    def read(batch: Any, lane: Any, n: int) -> None:
        lane.time = batch.time[n]
        for i in range(4):
            lane.observation[i] = observed(batch.controller.observation, n)[i]
            lane.state[i] = observed(batch.state, n)[i]

    read = compilable(read)
    return kernel(release), kernel(step, cached=cached)


class Lanes:
    """Lanes of a world of compiled trials."""

    def __init__(self, simulation: Simulation, count: int, reward: Any, cached: bool) -> None:
        """Allocate the state; `release` comes next.

        Args:
            simulation: The world; its stream is that of the episodes.
            count: Number of lanes.
            reward: Reward of a step, callable in kernels.
            cached: Whether its code is cached on disk.

        Raises:
            InputError: The trials of this world are not compiled.
        """
        if not simulation.PIECE:
            raise InputError(
                f"the world {quoted(simulation.name)} runs from Python, so that it has no lanes; "
                "give vectorization_mode='sync' or 'async'"
            )
        self._simulation = simulation
        self._loops: list[Any] = [simulation.loop() for _ in range(0, count, simulation.BATCH)]
        kernels, trial = self._loops[0].KERNELS, simulation.draw(1).trial(0)
        worlds = [loop.prepare(trial) for loop in self._loops]
        self._release, step = compiled_lanes(kernels.place, kernels.advance, reward, cached)
        self._lanes: Records = np.zeros(count, record_type(Lane))
        self._numbers = self._lanes.view(np.int64)
        self._start, self._variation = np.zeros((count, WINDOW, 4)), np.zeros((count, WINDOW, 5))
        self._worlds = listed(worlds[0])
        for world in worlds[1:]:
            append(self._worlds, world)
        self._step = functools.partial(step, self._worlds, self._lanes, simulation.setup.h)
        threads = max(1, min(available_cores(), len(worlds) // WORLDS_AHEAD - 1))
        self.pool = ThreadPoolExecutor(threads)
        """Threads; to be shut down."""
        ends = np.linspace(WORLDS_AHEAD, len(worlds), threads + 1).round().astype(int).tolist()
        self._own, *self._others = pairwise([0, *ends[1:]])

    def release(self, rows: IntArray, seed: int | None = None) -> Records:
        """Begin the next episodes of some lanes, and return a `Lane` of each.

        Args:
            rows: The lanes.
            seed: Gives lane i the seed `seed` + i, and begins with its episode 0.
        """
        lanes, simulation = self._lanes, self._simulation
        if seed is not None:
            lanes["seed"], lanes["number"] = np.arange(len(lanes)) + seed, -1
        lanes["number"][rows] += 1
        place = lanes["number"][rows] % WINDOW
        for i in rows[place == 0].tolist():
            simulation.seed, first = lanes["seed"][i].item(), lanes["number"][i].item()
            drawn = simulation.draw(WINDOW, first)
            self._start[i], self._variation[i] = drawn.start, drawn.variation
        start, variation = self._start[rows, place], self._variation[rows, place]
        if simulation.BATCH == 1:  # each lane has a world of its own, which a trial changes
            for i, own in zip(rows.tolist(), variation.tolist(), strict=True):
                simulation.seed, number = lanes["seed"][i].item(), lanes["number"][i].item()
                self._loops[i].prepare(trial_of(number, (0.0,) * 4, own))
        self._release(self._worlds, lanes, rows, start, variation)
        return self._copy()

    def step(self, u: Array, over: IntArray) -> Records:
        """Advance the lanes by one tick, and return a `Lane` of each.

        Args:
            u: Acceleration of each flange along x, at most that of the paper counts [m/s^2],
                shape (n,).
            over: Lanes that begin their next episode instead.
        """
        others = [self.pool.submit(self._step, *ends, u) for ends in self._others]
        self._step(*self._own, u)
        for other in others:
            other.result()
        return self.release(over) if over.size else self._copy()

    def _copy(self) -> Records:
        """Return a copy of the lanes, made at once instead of field by field."""
        return self._numbers.copy().view(self._lanes.dtype)
