r"""Tabular Q-learning over the full closed loop: the paper's equation (1).

.. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha (r + \gamma \max_{a'} Q(s', a'))

One compiled loop runs whole episodes; a failure is terminal, so its target is the reward alone.
With `mirrored`, the mirror image of each update is made with it, so that the table stays exactly
symmetric. Ties between best actions are broken at random.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.control.boxes import Boxes, box_index, mirrored_box
from equipoise.learning.closed_loop import (
    LASTED,
    Plant,
    draw_noise,
    new_memory,
    reset,
    scaled,
    step,
)
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import (
    TO_UNIT,
    TRAINING_ACTION,
    TRAINING_EPISODE,
    TRAINING_NOISE,
    TRAINING_START,
    normal_pair,
    philox,
    uniform,
)

Array = npt.NDArray[np.float64]


class Learner(NamedTuple):
    """Constants of a training; each is described in `equipoise.settings.LearningSettings`."""

    episodes: int
    longest: int
    """Steps after which an episode is cut off, without a failure."""
    gamma: float
    alpha_initial: float
    alpha_decay: float
    alpha_minimum: float
    epsilon_initial: float
    epsilon_until: float
    reward_failure: float
    mirrored: bool
    start: Array
    """Half widths of x, x_dot, phi, phi_dot at the start, shape (4,)."""
    inertia_sigma: float
    friction_sigma: float
    boxes: Boxes
    actions: Array
    """Accelerations [m/s^2], shape (8,)."""


@kernel
def learning_rate(visits: float, learner: Learner) -> float:
    """Return alpha of a state-action pair that was visited so often before."""
    rate = learner.alpha_initial / (1.0 + learner.alpha_decay * visits)
    return max(rate, learner.alpha_minimum)


@kernel
def exploration(episode: int, learner: Learner) -> float:
    """Return the probability of a random action in an episode."""
    if learner.epsilon_until <= 0.0:
        return learner.epsilon_initial
    done = episode / (learner.epsilon_until * learner.episodes)
    return learner.epsilon_initial * max(0.0, 1.0 - done)


@kernel
def best_action(values: Array, word: int) -> int:
    """Return the index of the largest value, a random one of them (by `word`) if it is shared."""
    best = values[0]
    for i in range(1, values.size):
        if values[i] > best:
            best = values[i]
    ties = 0
    for i in range(values.size):
        if values[i] == best:
            ties += 1
    chosen = 0 if ties == 1 else int(word * TO_UNIT * ties)
    for i in range(values.size):
        if values[i] == best:
            if chosen == 0:
                return i
            chosen -= 1
    return 0  # a table never holds NaN, so some value equals the largest


@kernel
def update(
    Q: Array,
    visits: npt.NDArray[np.int64],
    box: int,
    action: int,
    target: float,
    learner: Learner,
) -> None:
    """Apply equation (1) to one state-action pair, and to its mirror image if asked.

    Args:
        Q: State-action values, shape (270, 8), changed in place.
        visits: Updates so far, shape (270, 8), changed in place.
        box: Box of the state s.
        action: Index of the action a.
        target: r + gamma max Q(s', a'), or r alone after a failure.
        learner: Constants.
    """
    alpha = learning_rate(visits[box, action], learner)
    Q[box, action] = (1.0 - alpha) * Q[box, action] + alpha * target
    visits[box, action] += 1
    if learner.mirrored:
        box_m, action_m = mirrored_box(box), Q.shape[1] - 1 - action
        Q[box_m, action_m] = Q[box, action]
        visits[box_m, action_m] = visits[box, action]


@kernel
def train_episodes(
    plant: Plant,
    pendulum: PendulumParameters,
    learner: Learner,
    Q: Array,
    visits: npt.NDArray[np.int64],
    first: int,
    last: int,
    seed: int,
    number: int,
) -> int:
    """Train through the episodes first <= i < last.

    Args:
        plant: Constants of the closed loop.
        pendulum: The centre that each episode varies.
        learner: Constants of the training.
        Q: State-action values, shape (270, 8), changed in place.
        visits: Updates so far, shape (270, 8), changed in place.
        first: First episode.
        last: One past the last episode.
        seed: Master seed.
        number: Which learner of that seed; each has numbers of its own.

    Returns:
        Steps taken.
    """
    memory = new_memory()
    state = memory.state
    start = np.empty(4)
    steps = 0
    for episode in range(first, last):
        w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_EPISODE)
        inertia_noise, friction_noise = normal_pair(w0, w1)
        own = scaled(
            pendulum,
            1.0 + learner.inertia_sigma * inertia_noise,
            max(0.0, 1.0 + learner.friction_sigma * friction_noise),
        )
        w0, w1, w2, w3 = philox(seed, 0, episode, number, TRAINING_START)
        start[0] = uniform(w0, -learner.start[0], learner.start[0])
        start[1] = uniform(w1, -learner.start[1], learner.start[1])
        start[2] = uniform(w2, -learner.start[2], learner.start[2])
        start[3] = uniform(w3, -learner.start[3], learner.start[3])
        reset(plant, memory, start[0], start[1], start[2], start[3])
        epsilon = exploration(episode, learner)
        box = box_index(state[0], state[1], state[2], state[3], learner.boxes)
        for tick in range(learner.longest):
            w0, w1, w2, w3 = philox(seed, tick, episode, number, TRAINING_ACTION)
            if w0 * TO_UNIT < epsilon:
                action = int(w1 * TO_UNIT * learner.actions.size)
            else:
                action = best_action(Q[box], w1)
            noise = draw_noise(seed, tick, episode, number, TRAINING_NOISE)
            cause = step(plant, memory, learner.actions[action], noise, own).cause
            steps += 1
            if cause != LASTED:
                update(Q, visits, box, action, learner.reward_failure, learner)
                break
            box_next = box_index(state[0], state[1], state[2], state[3], learner.boxes)
            target = learner.gamma * np.max(Q[box_next])
            update(Q, visits, box, action, target, learner)
            box = box_next
    return steps
