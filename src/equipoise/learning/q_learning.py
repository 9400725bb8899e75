r"""Tabular Q-learning over the full closed loop: the paper's equation (1).

.. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha (r + \gamma \max_{a'} Q(s', a'))

With `held` an action lasts until the state leaves its box, n steps, and is updated then, with
gamma^n in place of gamma: the update of a semi-Markov process (Bradtke & Duff 1994), of which
equation (1) is the case n = 1. Within a box nothing changes that the table could see, so a greedy
policy holds its action anyway.

One compiled loop runs whole episodes, `BATCH_SIZE` of them at once, all learning on the one table:
in each step every lane acts by the table as it stands, then the updates are made one after the
other. A failure is terminal, so its target is the reward alone. With `mirrored`, the mirror image
of each update is made with it, so that the table stays exactly symmetric. Ties between best actions
are broken at random.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import inlined, kernel
from equipoise.control.boxes import ACTIONS, COUNT, TRUNCATED, Boxes, mirrored_box
from equipoise.learning.closed_loop import (
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
from equipoise.model.elementary import BATCH_SIZE
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

Array = npt.NDArray[np.float64]


BEGUN: Final = 0
ENDED: Final = 1
IN_USE: Final = 2
STEPS: Final = 3
ENDED_STEPS: Final = 4


class QLearningConfig(NamedTuple):
    """Constants of a training; each is described in `equipoise.settings.LearningSettings`."""

    episodes: int
    max_steps: int
    """Steps after which an episode is cut off, without a failure."""
    gamma: float
    alpha_initial: float
    alpha_decay: float
    alpha_minimum: float
    epsilon_initial: float
    epsilon_until: float
    reward_failure: float
    mirrored: bool
    hold_action: bool
    start: tuple[float, float, float, float]
    """Half widths of x, x_dot, phi, phi_dot at the start."""
    inertia_sigma: float
    friction_sigma: float
    delay_spread: float
    lag_spread: float
    zero_error: float
    boxes: Boxes
    actions: tuple[float, ...]
    """Accelerations [m/s^2]."""


@inlined
def learning_rate(visits: float, learner: QLearningConfig) -> float:
    """Return alpha of a state-action pair that was visited so often before."""
    rate = learner.alpha_initial / (1.0 + learner.alpha_decay * visits)
    return max(rate, learner.alpha_minimum)


@inlined
def exploration(episode: int, learner: QLearningConfig) -> float:
    """Return the probability of a random action in an episode."""
    if learner.epsilon_until <= 0.0:
        return learner.epsilon_initial
    done = episode / (learner.epsilon_until * learner.episodes)
    return learner.epsilon_initial * max(0.0, 1.0 - done)


@inlined
def discount(steps: int, learner: QLearningConfig) -> float:
    """Return gamma to the power of a number of steps."""
    # As a float: Numba's power of whole numbers rounds otherwise than Python's.
    return learner.gamma ** float(steps)


@inlined
def best_value(Q: Array, box: int) -> float:
    """Return the largest value of a box."""
    best = Q[box, 0]
    for i in range(1, Q.shape[1]):
        best = max(best, Q[box, i])
    return best


@inlined
def best_action(Q: Array, box: int, word: int) -> int:
    """Return the action of the largest value of a box, a random one (by `word`) if it is shared."""
    best = best_value(Q, box)
    ties = 0
    for i in range(Q.shape[1]):
        ties += Q[box, i] == best
    skip = int(uniform(word, 0.0, ties))
    action = 0
    for i in range(Q.shape[1]):
        if Q[box, i] == best:
            if skip == 0:
                action = i
            skip -= 1
    return action


@inlined
def update(
    Q: Array,
    visits: npt.NDArray[np.int64],
    box: int,
    action: int,
    target: float,
    learner: QLearningConfig,
) -> None:
    """Apply equation (1) to one state-action pair, and to its mirror image if asked.

    Args:
        Q: State-action values, shape (270, 8), changed in place.
        visits: Updates so far, shape (270, 8), changed in place.
        box: Box of the state s.
        action: Index of the action a.
        target: r + gamma max Q(s', a'), or r alone after a failure; discounted from its time.
        learner: Constants.
    """
    alpha = learning_rate(visits[box, action], learner)
    Q[box, action] = (1.0 - alpha) * Q[box, action] + alpha * target
    visits[box, action] += 1
    if learner.mirrored:
        box_m, action_m = mirrored_box(box), Q.shape[1] - 1 - action
        Q[box_m, action_m] = Q[box, action]
        visits[box_m, action_m] = visits[box, action]


class TrainingState(NamedTuple):
    """A training under way: the table, and the episodes that its lanes are in."""

    Q: Array
    """State-action values, shape (270, 8)."""
    visits: npt.NDArray[np.int64]
    """Updates of each, shape (270, 8)."""
    batch: BatchState
    """States of the running episodes."""
    episode: npt.NDArray[np.int64]
    """Episode of each lane, shape (BATCH_SIZE,)."""
    tick: npt.NDArray[np.int64]
    """Its step, shape (BATCH_SIZE,)."""
    box: npt.NDArray[np.int64]
    """Its box, shape (BATCH_SIZE,)."""
    action: npt.NDArray[np.int64]
    """Index of its action, shape (BATCH_SIZE,)."""
    held_steps: npt.NDArray[np.int64]
    """Steps for which it has been held in this box, shape (BATCH_SIZE,)."""
    totals: npt.NDArray[np.int64]
    """Episodes begun, episodes ended, lanes in use, steps, steps of ended episodes; shape (5,)."""


def new_training_state() -> TrainingState:
    """Return a training that has not begun: a table of zeros."""
    return TrainingState(
        Q=np.zeros((COUNT, ACTIONS)),
        visits=np.zeros((COUNT, ACTIONS), np.int64),
        batch=new_batch_state(),
        episode=np.zeros(BATCH_SIZE, np.int64),
        tick=np.zeros(BATCH_SIZE, np.int64),
        box=np.zeros(BATCH_SIZE, np.int64),
        action=np.zeros(BATCH_SIZE, np.int64),
        held_steps=np.zeros(BATCH_SIZE, np.int64),
        totals=np.zeros(5, np.int64),
    )


@kernel
def begin_episode(
    plant: LoopParams,
    pendulum: PendulumParameters,
    learner: QLearningConfig,
    progress: TrainingState,
    seed: int,
    number: int,
    n: int,
) -> None:
    """Begin the next episode in lane `n`: its pendulum and its start are drawn."""
    episode = progress.totals[BEGUN]
    w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_EPISODE)
    inertia_noise, friction_noise = normal_pair(w0, w1)
    w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_ACTUATOR)
    variation = DomainRandomization(
        1.0 + learner.inertia_sigma * inertia_noise,
        1.0 + learner.friction_sigma * friction_noise,
        uniform(w0, -learner.delay_spread, learner.delay_spread),
        uniform(w1, 1.0 - learner.lag_spread, 1.0 + learner.lag_spread),
        uniform(w2, -learner.zero_error, learner.zero_error),
    )
    w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_START)
    x, x_dot, phi, phi_dot = learner.start
    start = (
        uniform(w0, -x, x),
        uniform(w1, -x_dot, x_dot),
        uniform(w2, -phi, phi),
        uniform(w3, -phi_dot, phi_dot),
    )
    reset(plant, progress.batch, pendulum, variation, start, n)
    progress.episode[n] = episode
    progress.tick[n] = progress.held_steps[n] = 0
    progress.box[n] = box_of(progress.batch.controller.observation, learner.boxes, n)
    progress.totals[BEGUN] += 1


@kernel
def train_episodes(
    plant: LoopParams,
    pendulum: PendulumParameters,
    learner: QLearningConfig,
    progress: TrainingState,
    until: int,
    seed: int,
    number: int,
) -> None:
    """Train until so many episodes have ended.

    Must equal `tests/reference/q_learning.py`.

    Args:
        plant: Constants of the closed loop.
        pendulum: The centre that each episode varies.
        learner: Constants of the training.
        progress: Changed in place; a later call goes on where this one stopped.
        until: Number of ended episodes at which to stop, at most `learner.episodes`.
        seed: Master seed.
        number: Which learner of that seed; each has random numbers of its own.
    """
    Q, visits, block, episode, tick, box, action, held, totals = progress
    memory, cause = block.controller, block.cause
    seen, u = memory.observation, memory.u
    lanes = totals[IN_USE]
    while lanes < BATCH_SIZE and totals[BEGUN] < learner.episodes:
        begin_episode(plant, pendulum, learner, progress, seed, number, lanes)
        lanes += 1
    while totals[ENDED] < until and lanes > 0:
        for n in range(lanes):
            if held[n] == 0:
                w0, w1, _, _ = philox(seed, tick[n], episode[n], number, TRAINING_ACTION)
                if uniform(w0, 0.0, 1.0) < exploration(episode[n], learner):
                    action[n] = int(uniform(w1, 0.0, len(learner.actions)))
                else:
                    action[n] = best_action(Q, box[n], w1)
            u[n] = learner.actions[action[n]]
        draw_noise(memory.noise, seed, tick, episode, number, TRAINING_NOISE, lanes)
        step(plant, block, lanes)
        totals[STEPS] += lanes
        for n in range(lanes - 1, -1, -1):
            tick[n] += 1
            if cause[n] == TRUNCATED:
                box_next = box_of(seen, learner.boxes, n)
                held[n] += 1
                if learner.hold_action and box_next == box[n] and tick[n] < learner.max_steps:
                    continue
                target = discount(held[n], learner) * best_value(Q, box_next)
                update(Q, visits, box[n], action[n], target, learner)
                box[n], held[n] = box_next, 0
                if tick[n] < learner.max_steps:
                    continue
            else:
                target = discount(held[n], learner) * learner.reward_failure
                update(Q, visits, box[n], action[n], target, learner)
            totals[ENDED] += 1
            totals[ENDED_STEPS] += tick[n]
            if totals[BEGUN] < learner.episodes:
                begin_episode(plant, pendulum, learner, progress, seed, number, n)
            else:
                lanes -= 1
                copy_lane(block, lanes, n)
                episode[n], tick[n], box[n] = episode[lanes], tick[lanes], box[lanes]
                action[n], held[n] = action[lanes], held[lanes]
    totals[IN_USE] = lanes
