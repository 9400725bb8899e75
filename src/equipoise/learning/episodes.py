"""Episode loop of the training: it acts, collects rewards, and lets an algorithm update its table.

One loop runs whole episodes, `BATCH_SIZE` of them at once on the compiled plant, that share one
table: in each step every lane acts by the current table, then the updates follow one after the
other. An episode that reaches the time limit ends without a failure. In any other world, the same
loop runs in Python, an episode after the other, as the paper trained in V-REP.

The learning rule is in `equipoise.learning.q_learning`, the rewards in
`equipoise.learning.rewards`.
"""

import functools
from collections.abc import Generator
from math import inf
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np

from equipoise import paper
from equipoise.arrays import Array, IntArray, Records, new_records, rows_of
from equipoise.control.control_step import LANES, Observed
from equipoise.control.policy import LearningPoint
from equipoise.elementary import BATCH_SIZE
from equipoise.errors import InputError
from equipoise.jit import Kernel, call, compilable, inlined, kernel
from equipoise.learning.choice import compile_functions, load_algorithm
from equipoise.learning.q_learning import (
    Tables,
    Transition,
    UpdateParams,
    epsilon_greedy,
    new_tables,
)
from equipoise.model import random
from equipoise.model.grid import TRUNCATED, Grid, make_grid
from equipoise.model.worlds import MODEL
from equipoise.settings import Settings
from equipoise.simulation import ClosedLoop, Setup, predicted, simulate
from equipoise.simulation.ideal import PlantSimulation
from equipoise.simulation.plant import (
    BatchState,
    DomainRandomization,
    LoopParams,
    Trial,
    box_of,
    copy_lane,
    draw_noise,
    observed,
)
from equipoise.user_code import user_code


class TrainingConfig(NamedTuple):
    """Constants of a training; each is described in `equipoise.settings.LearningSettings`."""

    episodes: int
    max_steps: int
    """Number of steps after which an episode ends without a failure."""
    epsilon_initial: float
    epsilon_until: float
    update_params: UpdateParams
    """Constants of an update."""
    start: tuple[float, float, float, float]
    """Half widths of the ranges of x, x_dot, phi, phi_dot at the start, SI units."""
    spread: DomainRandomization
    """Standard deviations of the factors on I and b, half widths of the ranges of the others."""
    actions: Array
    """Accelerations [m/s^2], shape (8,)."""
    boxes: Grid
    """Grid of the tables."""
    seed: int
    """Master seed."""


class Episodes(Protocol):
    """Episodes that run side by side."""

    batch: BatchState
    """States of their closed loops."""
    before: Observed
    """Observations before the step."""
    box: Annotated[IntArray, LANES]
    """Box of the observation."""
    box_next: Annotated[IntArray, LANES]
    """Box after the step."""
    action: Annotated[IntArray, LANES]
    """Index of the action."""
    epsilon: Annotated[Array, LANES]
    """Probability of a random action in the episode."""
    chance: Annotated[Array, LANES]
    """Uniform random number in [0, 1) of the step, for the algorithm."""
    lane: Annotated[IntArray, LANES]
    """Index among the running episodes, constant over an episode."""
    episode: Annotated[IntArray, LANES]
    """Number of the episode."""
    tick: Annotated[IntArray, LANES]
    """Number of steps of the episode."""


class Totals(Protocol):
    """Progress of a training."""

    begun: int
    """Episodes begun."""
    ended: int
    """Episodes ended."""
    steps: int
    """Steps of all episodes."""
    ended_steps: int
    """Steps of the ended episodes."""


class TrainingState(NamedTuple):
    """State of a training, changed in place."""

    tables: Tables
    """Tables that the algorithm changes."""
    episodes: Records
    """`Episodes`."""
    rows: IntArray
    """Bits of the episodes as rows of lanes, from `rows_of`."""
    totals: Records
    """`Totals`."""


def new_training_state(boxes: int, tables: int = 0) -> TrainingState:
    """Return the initial state of a training, with tables of zeros.

    Args:
        boxes: Number of boxes of a table.
        tables: Number of tables of the algorithm's own.
    """
    episodes = new_records(Episodes)
    episodes["lane"] = np.arange(BATCH_SIZE)
    rows = rows_of(episodes, BATCH_SIZE)
    return TrainingState(new_tables(boxes, tables), episodes, rows, new_records(Totals))


@inlined
def draw_episode(config: TrainingConfig, episode: int) -> Trial:
    """Return the conditions of an episode."""
    seed, spread = config.seed, config.spread
    w0, w1, w2, w3 = random.philox(seed, 0, episode, 0, random.TRAINING_EPISODE)
    inertia_noise, friction_noise = random.normal_pair(w0, w1)
    w0, w1, w2, w3 = random.philox(seed, 0, episode, 0, random.TRAINING_ACTUATOR)
    variation = DomainRandomization(
        1.0 + spread.inertia_factor * inertia_noise,
        1.0 + spread.friction_factor * friction_noise,
        random.uniform(w0, -spread.delay, spread.delay),
        random.uniform(w1, 1.0 - spread.lag_factor, 1.0 + spread.lag_factor),
        random.uniform(w2, -spread.zero, spread.zero),
    )
    w0, w1, w2, w3 = random.philox(seed, 0, episode, 0, random.TRAINING_START)
    x, x_dot, phi, phi_dot = config.start
    start = (
        random.uniform(w0, -x, x),
        random.uniform(w1, -x_dot, x_dot),
        random.uniform(w2, -phi, phi),
        random.uniform(w3, -phi_dot, phi_dot),
    )
    return Trial(episode, start, variation)


@compilable
def release_on_plant(plant: LoopParams, batch: BatchState, trial: Trial, n: int) -> None:
    """Release the pendulum of an episode on the compiled plant, in lane `n`."""
    call(plant.reset, (plant, batch, trial, n))


@inlined
def step_on_plant(plant: LoopParams, config: TrainingConfig, running: Episodes, lanes: int) -> None:
    """Advance the episodes of the first lanes on the compiled plant."""
    noise, tick, episode = running.batch.controller.noise, running.tick, running.episode
    draw_noise(noise, config.seed, tick, episode, random.TRAINING_NOISE, lanes)
    call(plant.step, (plant, running.batch, lanes))


def release_in_world(loop: ClosedLoop, batch: BatchState, trial: Trial, n: int) -> None:
    """Release the pendulum of an episode in any world."""
    loop.reset(trial)
    seen = batch.controller.observation
    seen.x[n], seen.x_dot[n], seen.phi[n], seen.phi_dot[n] = predicted(loop)


def step_in_world(loop: ClosedLoop, config: TrainingConfig, running: Episodes, lanes: int) -> None:
    """Advance the episode of the only lane in any world."""
    batch = running.batch
    seen = batch.controller.observation
    batch.cause[0] = loop.step(float(batch.controller.u[0]))
    seen.x[0], seen.x_dot[0], seen.phi[0], seen.phi_dot[0] = predicted(loop)


def episode_loop(update: Kernel, reward: Kernel, release: Kernel, advance: Kernel) -> Kernel:
    """Return the episode loop of an algorithm, a reward and a world.

    Args:
        update: `Algorithm.update`.
        reward: A reward of `equipoise.learning.rewards`.
        release: Releases the pendulum of an episode, as `release_on_plant`.
        advance: Advances the running episodes, as `step_on_plant`.
    """

    def train_episodes(
        world: Any, config: TrainingConfig, training: TrainingState, until: int, batch_size: int
    ) -> None:
        """Train until a number of episodes have ended.

        Must equal `tests/reference/learning.py`.

        Args:
            world: Plant or closed loop.
            config: Constants of the training.
            training: State; the next call continues from it.
            until: Number of ended episodes at which to stop, at most `config.episodes`.
            batch_size: Number of episodes that run side by side.
        """
        tables, running, totals = training.tables, training.episodes[0], training.totals[0]
        batch, before, seen = running.batch, running.before, running.batch.controller.observation
        box, action, tick, u = running.box, running.action, running.tick, batch.controller.u
        episode, epsilon, chance = running.episode, running.epsilon, running.chance
        seed, lanes = config.seed, totals.begun - totals.ended

        def begin(n: int) -> None:
            release(world, batch, draw_episode(config, totals.begun), n)
            box[n] = box_of(seen, config.boxes, n)
            falls = config.epsilon_until * config.episodes
            done = min(totals.begun / falls, 1.0) if falls > 0.0 else 0.0
            epsilon[n] = config.epsilon_initial * (1.0 - done)
            episode[n], tick[n] = totals.begun, 0
            totals.begun += 1

        while lanes < batch_size and totals.begun < config.episodes:
            begin(lanes)
            lanes += 1
        while totals.ended < until and lanes > 0:
            for n in range(lanes):
                w0, w1, w2, _ = random.philox(seed, tick[n], episode[n], 0, random.TRAINING_ACTION)
                explore, choice = random.uniform(w0, 0.0, 1.0), random.uniform(w1, 0.0, 1.0)
                action[n] = epsilon_greedy(tables.Q, box[n], epsilon[n], explore, choice)
                u[n], chance[n] = config.actions[action[n]], random.uniform(w2, 0.0, 1.0)
            for n in range(BATCH_SIZE):
                before.x[n], before.x_dot[n] = seen.x[n], seen.x_dot[n]
                before.phi[n], before.phi_dot[n] = seen.phi[n], seen.phi_dot[n]
            advance(world, config, running, lanes)
            totals.steps += lanes
            for n in range(BATCH_SIZE):
                running.box_next[n] = box_of(seen, config.boxes, n)
                tick[n] += 1
            for n in range(lanes - 1, -1, -1):
                failed = batch.cause[n] != TRUNCATED
                ended = failed or tick[n] >= config.max_steps
                r = reward(observed(before, n), u[n], observed(seen, n), failed)
                s, s_next, lane = box[n], running.box_next[n], running.lane[n]
                transition = Transition(
                    s, action[n], r, s_next, failed, ended, epsilon[n], chance[n], lane
                )
                update(tables, transition, config.update_params)
                box[n] = s_next
                if not ended:
                    continue
                totals.ended += 1
                totals.ended_steps += tick[n]
                if totals.begun < config.episodes:
                    begin(n)
                else:
                    lanes -= 1
                    copy_lane(training.rows, lanes, n)

    return train_episodes


def learn(
    setup: Setup, world: str, seed: int, every: int
) -> Generator[tuple[LearningPoint, Tables]]:
    """Train tables of zeros, and yield them again and again on the way.

    Args:
        setup: Pendulum, arm and controller; resolved settings.
        world: `model`, the compiled plant, or any other world.
        seed: Master seed.
        every: Minimum number of episodes between two yields.

    Yields:
        Point of the learning curve, and the tables, which the next episodes change.

    Raises:
        InputError: A user's function has another type, cannot be compiled or raised an error, or a
            value is not finite.
        SettingsError: The world does not exist.
    """
    settings, learning = setup.settings, setup.settings.learning
    update, reward, cached = compile_functions(learning)
    config = training_config(settings, setup.pendulum.parameters().k, seed)
    training = new_training_state(settings.boxes.count, load_algorithm(learning).tables)
    tables, totals = training.tables, training.totals[0]
    if world == MODEL:
        plant = PlantSimulation(MODEL, setup, seed=seed, stream=random.TRAINING_NOISE)
        # The boxes do not resolve speeds below the limit; selection finds tables that keep it.
        lanes: Any = plant.params._replace(max_speed=inf)
        train_episodes, batch_size = compiled_loop(update, reward, cached), BATCH_SIZE
    else:
        lanes = simulate(world, setup, seed=seed, stream=random.TRAINING_NOISE).loop()
        train_episodes = episode_loop(update, reward, release_in_world, step_in_world)
        batch_size = 1
    while totals.ended < learning.episodes:
        ended, ended_steps = int(totals.ended), int(totals.ended_steps)
        until = min(ended + every, learning.episodes)
        with user_code(f"the algorithm {learning.algorithm} or the reward {learning.reward}"):
            train_episodes(lanes, config, training, until, batch_size)
        if not np.isfinite(tables.Q).all():
            raise InputError(
                f"the table holds a value that is not finite after {totals.ended} episodes with "
                f"the algorithm {learning.algorithm} and the reward {learning.reward}; bound the "
                "reward, or lower the learning rate"
            )
        duration = paper.STEP * (totals.ended_steps - ended_steps) / (totals.ended - ended)
        point = LearningPoint(
            episodes=int(totals.ended), steps=int(totals.steps), duration=float(duration)
        )
        yield point, tables


@functools.cache
def compiled_loop(update: Kernel, reward: Kernel, cached: bool) -> Kernel:
    """Return the compiled episode loop on the plant."""
    loop = episode_loop(update, reward, release_on_plant, step_on_plant)
    return kernel(loop, cached=cached)


def training_config(settings: Settings, k: float, seed: int) -> TrainingConfig:
    """Return the configuration of the episode loop.

    Args:
        settings: Resolved settings.
        k: Coupling of the pendulum to the pivot's acceleration [1/m].
        seed: Master seed.
    """
    learning, plant = settings.learning, settings.plant
    return TrainingConfig(
        episodes=learning.episodes,
        max_steps=round(learning.episode_duration / paper.STEP),
        epsilon_initial=learning.epsilon_initial,
        epsilon_until=learning.epsilon_until,
        update_params=UpdateParams(**learning.model_dump(include=set(UpdateParams._fields))),
        start=(learning.start_x, learning.start_x_dot, learning.start_phi, learning.start_phi_dot),
        spread=DomainRandomization(
            plant.inertia_sigma,
            plant.friction_sigma,
            plant.delay_spread,
            plant.lag_spread,
            plant.zero_error,
        ),
        actions=np.array(paper.ACTIONS),
        boxes=make_grid(settings.boxes, k),
        seed=seed,
    )
