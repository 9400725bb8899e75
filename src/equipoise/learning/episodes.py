"""Episode loop of the training: it acts, collects rewards, and lets a learner update its table.

One compiled loop runs whole episodes, `BATCH_SIZE` of them at once, that share one table: in each
step every lane acts by the current table, then the updates follow one after the other. An episode
that reaches the time limit ends without a failure.

With `hold_action` an action lasts until the state leaves its box, n steps, and is updated then:
rewards are discounted to its first step, and the value of the next box by gamma^n. The
observation of a table does not change within a box, so a greedy policy holds its action anyway.

The learning rule is in `equipoise.learning.q_learning`, the rewards in
`equipoise.learning.rewards`.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array, IntArray
from equipoise.control.grid import TRUNCATED, Grid
from equipoise.jit import called, inlined, kernel, struct_ref
from equipoise.learning.learner import (
    CONTINUES,
    DECIDED,
    FAILED,
    TIMED_OUT,
    UNDECIDED,
    Decisions,
    LearnerKernel,
    Results,
    Tables,
    UpdateParams,
    epsilon_greedy,
    new_decisions,
    new_results,
    new_tables,
)
from equipoise.model.elementary import BATCH_SIZE, zeros
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import (
    TRAINING_ACTION,
    TRAINING_ACTUATOR,
    TRAINING_EPISODE,
    TRAINING_NOISE,
    TRAINING_START,
    normal_pair,
    philox,
    uniform,
)
from equipoise.worlds.plant import (
    BatchState,
    DomainRandomization,
    LoopParams,
    box_of,
    copy_lane,
    draw_noise,
    new_batch_state,
    reset,
    step,
)

# Entries of `TrainingState.totals`.
BEGUN: Final = 0
ENDED: Final = 1
IN_USE: Final = 2
STEPS: Final = 3
ENDED_STEPS: Final = 4


class TrainingConfig(NamedTuple):
    """Constants of a training; each is described in `equipoise.settings.LearningSettings`."""

    episodes: int
    max_steps: int
    """Number of steps after which an episode ends without a failure."""
    gamma: float
    epsilon_initial: float
    epsilon_until: float
    hold_action: bool
    update: UpdateParams
    """Constants of an update."""
    start: tuple[float, float, float, float]
    """Half widths of the ranges of x, x_dot, phi, phi_dot at the start, SI units."""
    inertia_sigma: float
    friction_sigma: float
    delay_spread: float
    lag_spread: float
    zero_error: float
    actions: Array
    """Accelerations [m/s^2], shape (8,)."""
    boxes: Grid
    """Grid of the tables."""


@inlined
def exploration(episode: int, config: TrainingConfig) -> float:
    """Return the probability of a random action in an episode."""
    if config.epsilon_until <= 0.0:
        return config.epsilon_initial
    done = episode / (config.epsilon_until * config.episodes)
    return config.epsilon_initial * max(0.0, 1.0 - done)


class TrainingState(NamedTuple):
    """State of a training: the tables and the running episodes."""

    tables: Tables
    """Tables that the learner changes."""
    batch: BatchState
    """States of the running episodes."""
    episode: npt.NDArray[np.int64]
    """Number of the episode of each lane, shape (BATCH_SIZE,)."""
    tick: npt.NDArray[np.int64]
    """Current step of each episode, shape (BATCH_SIZE,)."""
    decisions: Decisions
    """Current decision of each episode."""
    before: Array
    """Observation before the step; a block of 4 rows."""
    totals: npt.NDArray[np.int64]
    """Episodes begun, episodes ended, lanes in use, steps, steps of ended episodes; shape (5,)."""


def new_training_state(boxes: int, tables: int = 0) -> TrainingState:
    """Return the initial state of a training, with tables of zeros.

    Args:
        boxes: Number of boxes of a table.
        tables: Number of tables of the learner's own.
    """
    return TrainingState(
        tables=new_tables(boxes, tables),
        batch=new_batch_state(),
        episode=np.zeros(BATCH_SIZE, np.int64),
        tick=np.zeros(BATCH_SIZE, np.int64),
        decisions=new_decisions(),
        before=zeros(4 * BATCH_SIZE),
        totals=np.zeros(5, np.int64),
    )


TrainingLoop: Any = struct_ref(
    "TrainingLoop", __name__, ("plant", "pendulum", "config", "learner", "training", "key")
)


@kernel
def new_training_loop(
    plant: LoopParams,
    pendulum: PendulumParameters,
    config: TrainingConfig,
    learner: LearnerKernel,
    training: TrainingState,
    key: IntArray,
) -> Any:
    """Return a training that `train_episodes` takes by reference.

    Args:
        plant: Constants of the closed loop.
        pendulum: Nominal pendulum; each episode varies it.
        config: Constants of the training.
        learner: Compiled learner and reward.
        training: State; changed in place.
        key: Master seed, and number of the learner: each has its own random numbers; shape (2,).
    """
    return TrainingLoop(plant, pendulum, config, learner, training, key)


@inlined
def draw_episode(
    config: TrainingConfig, seed: int, episode: int, number: int
) -> tuple[DomainRandomization, tuple[float, float, float, float]]:
    """Return the variation of the plant of an episode, and its start in SI units."""
    w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_EPISODE)
    inertia_noise, friction_noise = normal_pair(w0, w1)
    w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_ACTUATOR)
    variation = DomainRandomization(
        1.0 + config.inertia_sigma * inertia_noise,
        1.0 + config.friction_sigma * friction_noise,
        uniform(w0, -config.delay_spread, config.delay_spread),
        uniform(w1, 1.0 - config.lag_spread, 1.0 + config.lag_spread),
        uniform(w2, -config.zero_error, config.zero_error),
    )
    w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_START)
    x, x_dot, phi, phi_dot = config.start
    start = (
        uniform(w0, -x, x),
        uniform(w1, -x_dot, x_dot),
        uniform(w2, -phi, phi),
        uniform(w3, -phi_dot, phi_dot),
    )
    return variation, start


@called
def begin_episode(
    plant: LoopParams,
    pendulum: PendulumParameters,
    config: TrainingConfig,
    training: TrainingState,
    seed: int,
    number: int,
    n: int,
) -> None:
    """Begin the next episode in lane `n`: draw its pendulum, actuator and start."""
    episode = training.totals[BEGUN]
    variation, start = draw_episode(config, seed, episode, number)
    reset(plant, training.batch, pendulum, variation, start, n)
    training.episode[n], training.tick[n] = episode, 0
    decisions = training.decisions
    decisions.action[n], decisions.gained[n], decisions.discount[n] = UNDECIDED, 0.0, 1.0
    decisions.epsilon[n] = exploration(episode, config)
    decisions.box[n] = box_of(training.batch.controller.observation, config.boxes, n)
    training.totals[BEGUN] += 1


@inlined
def decide(config: TrainingConfig, training: TrainingState, key: IntArray, lanes: int) -> None:
    """Choose the actions of undecided episodes, and write the accelerations of all."""
    Q, decisions, controller = training.tables.Q, training.decisions, training.batch.controller
    box, action, epsilon = decisions.box, decisions.action, decisions.epsilon
    tick, episode, u, actions = training.tick, training.episode, controller.u, config.actions
    for n in range(lanes):
        if action[n] == UNDECIDED:
            w0, w1, w2, _ = philox(key[0], tick[n], episode[n], key[1], TRAINING_ACTION)
            explore, choice = uniform(w0, 0.0, 1.0), uniform(w1, 0.0, 1.0)
            action[n] = epsilon_greedy(Q, box[n], epsilon[n], explore, choice)
            decisions.chance[n] = uniform(w2, 0.0, 1.0)
        u[n] = actions[action[n]]
    before, observation = training.before, controller.observation
    for i in range(before.size):
        before[i] = observation[i]


@inlined
def learn(
    config: TrainingConfig,
    learner: LearnerKernel,
    training: TrainingState,
    results: Results,
    lanes: int,
) -> None:
    """Learn from a step: rewards, boxes and outcomes, then the updates of complete decisions."""
    block, decisions, tick = training.batch, training.decisions, training.tick
    box, gained, discount = decisions.box, decisions.gained, decisions.discount
    reward, box_next, outcome = results
    seen, u, cause = block.controller.observation, block.controller.u, block.cause
    learner.rewards(training.before, u, seen, cause, reward, lanes)
    for n in range(lanes):
        box_next[n] = box_of(seen, config.boxes, n)
    for n in range(lanes):
        gained[n] += discount[n] * reward[n]
        discount[n] *= config.gamma
        tick[n] += 1
    for n in range(lanes):
        held = config.hold_action & (box_next[n] == box[n])
        going = CONTINUES if held else DECIDED
        going = TIMED_OUT if tick[n] >= config.max_steps else going
        outcome[n] = FAILED if cause[n] != TRUNCATED else going
    learner.learn(training.tables, decisions, results, config.update, lanes)


@kernel
def train_episodes(loop: Any, until: int) -> None:
    """Train until a number of episodes have ended.

    Must equal `tests/reference/learning.py`.

    Args:
        loop: The training, from `new_training_loop`; the next call continues from its state.
        until: Number of ended episodes at which to stop, at most `config.episodes`.
    """
    plant, pendulum, config, learner = loop.plant, loop.pendulum, loop.config, loop.learner
    training, key = loop.training, loop.key
    block, episode, tick = training.batch, training.episode, training.tick
    box, action, chance, gained, discount, epsilon, place = training.decisions
    totals, noise = training.totals, block.controller.noise
    seed, number = key[0], key[1]
    # New arrays, so that the compiler knows that nothing else points to them.
    results = new_results()
    outcome = results.outcome
    lanes = totals[IN_USE]
    while lanes < BATCH_SIZE and totals[BEGUN] < config.episodes:
        begin_episode(plant, pendulum, config, training, seed, number, lanes)
        lanes += 1
    while totals[ENDED] < until and lanes > 0:
        decide(config, training, key, lanes)
        draw_noise(noise, seed, tick, episode, number, TRAINING_NOISE, lanes)
        step(plant, block, lanes)
        totals[STEPS] += lanes
        learn(config, learner, training, results, lanes)
        for n in range(lanes - 1, -1, -1):
            if outcome[n] < TIMED_OUT:
                continue
            totals[ENDED] += 1
            totals[ENDED_STEPS] += tick[n]
            if totals[BEGUN] < config.episodes:
                begin_episode(plant, pendulum, config, training, seed, number, n)
            else:
                lanes -= 1
                copy_lane(block, lanes, n)
                episode[n], place[n], tick[n] = episode[lanes], place[lanes], tick[lanes]
                box[n], action[n], discount[n] = box[lanes], action[lanes], discount[lanes]
                gained[n], chance[n], epsilon[n] = gained[lanes], chance[lanes], epsilon[lanes]
    totals[IN_USE] = lanes


@kernel
def begin_in_world(loop: Any) -> tuple[int, DomainRandomization, tuple[float, float, float, float]]:
    """Begin the next episode of a training whose episodes run in another world, one at a time.

    Args:
        loop: The training, from `new_training_loop`.

    Returns:
        Number of the episode, variation of its plant, and its start in SI units.
    """
    config, training, seed, number = loop.config, loop.training, loop.key[0], loop.key[1]
    episode = training.totals[BEGUN]
    begin_episode(loop.plant, loop.pendulum, config, training, seed, number, 0)
    variation, start = draw_episode(config, seed, episode, number)
    return episode, variation, start


@kernel
def decide_in_world(loop: Any, observation: Array) -> float:
    """Return the acceleration for an observation in the world [m/s^2].

    Args:
        loop: The training; its first lane keeps the decision.
        observation: x, x_dot, phi, phi_dot as predicted, shape (4,).
    """
    config, training = loop.config, loop.training
    controller = training.batch.controller
    for i in range(4):
        controller.observation[i * BATCH_SIZE] = observation[i]
    if training.tick[0] == 0:
        training.decisions.box[0] = box_of(controller.observation, config.boxes, 0)
    decide(config, training, loop.key, 1)
    return controller.u[0]


@kernel
def learn_in_world(loop: Any, observation: Array, cause: int) -> bool:
    """Learn from a step in the world; return whether the episode goes on.

    Args:
        loop: The training; its first lane has the decision.
        observation: x, x_dot, phi, phi_dot after the step, as predicted, shape (4,).
        cause: Cause of the failure in the step, `TRUNCATED` without one.
    """
    training = loop.training
    for i in range(4):
        training.batch.controller.observation[i * BATCH_SIZE] = observation[i]
    training.batch.cause[0] = cause
    training.totals[STEPS] += 1
    results = new_results()
    learn(loop.config, loop.learner, training, results, 1)
    if results.outcome[0] < TIMED_OUT:
        return True
    training.totals[ENDED] += 1
    training.totals[ENDED_STEPS] += training.tick[0]
    return False
