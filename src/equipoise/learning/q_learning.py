r"""Interface of an algorithm, the parts that algorithms share, and the paper's: Q-learning.

An `Algorithm` says how a table learns from one step: the episode loop
(`equipoise.learning.episodes`) calls its `update` with a `Transition`. A user brings an
`Algorithm`, or its `update` alone, as MODULE:NAME. `q_learning` is the paper's equation (1):

.. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha (r + \gamma \max_{a'} Q(s', a'))
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from equipoise.arrays import Array, IntArray
from equipoise.jit import inlined
from equipoise.model.grid import ACTIONS, mirrored_box


class Tables(NamedTuple):
    """Tables of a training, changed in place."""

    Q: Array
    """State-action values of the policy, shape (boxes, 8)."""
    visits: IntArray
    """Number of updates of each value, shape (boxes, 8)."""
    own: Array
    """Tables of the algorithm's own, shape (`Algorithm.tables`, boxes, 8); zeros at the start."""


class Transition(NamedTuple):
    """One step of an episode."""

    box: int
    """Box s before the step."""
    action: int
    """Index of the action a."""
    reward: float
    """Reward r of the step."""
    box_next: int
    """Box s' after the step; without meaning after a failure."""
    failed: bool
    """Whether the episode failed: no value follows."""
    ended: bool
    """Whether the episode ended, by failure or by its time limit."""
    epsilon: float
    """Probability of a random action in this episode."""
    chance: float
    """Uniform random number in [0, 1) of this step, for the algorithm's own use."""
    lane: int
    """Place of the episode among those that run side by side, 0 to 15; constant over an episode."""


class UpdateParams(NamedTuple):
    """Constants of an update; each is described in `equipoise.settings.LearningSettings`."""

    gamma: float
    alpha_initial: float
    alpha_decay: float
    alpha_minimum: float
    mirrored: bool


@inlined
def learning_rate(visits: float, params: UpdateParams) -> float:
    """Return alpha of a state-action pair after a number of visits."""
    rate = params.alpha_initial / (1.0 + params.alpha_decay * visits)
    return max(rate, params.alpha_minimum)


@inlined
def best_value(Q: Array, box: int) -> float:
    """Return the largest value of a box."""
    # In pairs: a chain of comparisons would take twice as long.
    low = max(max(Q[box, 0], Q[box, 1]), max(Q[box, 2], Q[box, 3]))
    high = max(max(Q[box, 4], Q[box, 5]), max(Q[box, 6], Q[box, 7]))
    return max(low, high)


@inlined
def best_action(Q: Array, box: int, choice: float) -> int:
    """Return the action of the largest value of a box.

    Args:
        Q: State-action values, shape (boxes, 8).
        box: The box.
        choice: Uniform random number in [0, 1) that decides between equal values.
    """
    best = best_value(Q, box)
    ties = 0
    for i in range(ACTIONS):
        ties += Q[box, i] == best
    skip = int(ties * choice)
    # Without branches: the action is the number of those before the chosen one.
    action, found = 0, 0
    for i in range(ACTIONS):
        found += Q[box, i] == best
        action += found <= skip
    return min(action, ACTIONS - 1)  # values that are not numbers have no best one


@inlined
def write_mirrored(table: Array | IntArray, box: int, action: int) -> None:
    """Copy an entry of a table to its mirror image."""
    table[mirrored_box(box, table.shape[0]), ACTIONS - 1 - action] = table[box, action]


@inlined
def move_towards(
    tables: Tables, box: int, action: int, target: float, params: UpdateParams
) -> None:
    r"""Move a value towards a target, count the visit, and do the same to the mirror image.

    .. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha \, target

    Args:
        tables: Changed in place.
        box: Box s.
        action: Index of the action a.
        target: New estimate of Q(s, a).
        params: Constants: the learning rate, and whether the mirror image is updated.
    """
    Q, visits = tables.Q, tables.visits
    alpha = learning_rate(visits[box, action], params)
    Q[box, action] = (1.0 - alpha) * Q[box, action] + alpha * target
    visits[box, action] += 1
    if params.mirrored:
        write_mirrored(Q, box, action)
        write_mirrored(visits, box, action)


@inlined
def epsilon_greedy(Q: Array, box: int, epsilon: float, explore: float, choice: float) -> int:
    """Return a random action with probability epsilon, else the best one.

    Args:
        Q: State-action values, shape (boxes, 8).
        box: Box of the state.
        epsilon: Probability of a random action.
        explore: Uniform random number in [0, 1) that decides whether the action is random.
        choice: Uniform random number in [0, 1) that selects among several actions.
    """
    if explore < epsilon:
        return int(ACTIONS * choice)
    return best_action(Q, box, choice)


class Algorithm(NamedTuple):
    """A learning rule for a table."""

    update: Callable[[Tables, Transition, UpdateParams], None]
    """Learn from one step: change `Tables` in place."""
    tables: int = 0
    """Number of tables of the algorithm's own."""


@inlined
def q_learning(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Apply equation (1); after a failure the target is the reward alone."""
    target = transition.reward
    if not transition.failed:
        target += params.gamma * best_value(tables.Q, transition.box_next)
    move_towards(tables, transition.box, transition.action, target, params)


def new_tables(boxes: int, own: int) -> Tables:
    """Return tables of zeros, `own` of them the algorithm's own."""
    return Tables(
        Q=np.zeros((boxes, ACTIONS)),
        visits=np.zeros((boxes, ACTIONS), np.int64),
        own=np.zeros((own, boxes, ACTIONS)),
    )
