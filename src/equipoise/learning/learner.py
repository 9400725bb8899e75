"""Interface of a learner, and the parts that learners share.

A `Learner` says how a table learns from one decision. The episode loop
(`equipoise.learning.episodes`) calls its two functions with plain numbers and arrays: `select`
chooses an action, `update` learns from a `Transition`. Each learner of the project is one file of
`equipoise.learning.learners`; a guest brings a `Learner`, or its `update` alone, as MODULE:NAME.

Both functions are compiled with Numba, for one signature, and passed to the loop as values
(`equipoise.compiled.function_pointer`): one compiled loop serves every learner.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from equipoise.compiled import inlined
from equipoise.control.boxes import ACTIONS, COUNT, mirrored_box

Array = npt.NDArray[np.float64]


class Tables(NamedTuple):
    """Tables of a training, changed in place."""

    Q: Array
    """State-action values of the policy, shape (270, 8)."""
    visits: npt.NDArray[np.int64]
    """Number of updates of each value, shape (270, 8)."""
    own: Array
    """Tables of the learner's own, shape (`Learner.tables`, 270, 8); zeros at the start."""


class Transition(NamedTuple):
    """One decision: an action, held for one or several steps, and its result."""

    box: int
    """Box s of the decision."""
    action: int
    """Index of the action a."""
    reward: float
    """Discounted sum of the rewards of its steps."""
    discount: float
    """Discount of the value of s', gamma to the number of steps."""
    box_next: int
    """Box s' after the last step; without meaning after a failure."""
    action_next: int
    """Index of the next action a' where the learner chooses ahead, else -1."""
    failed: bool
    """Whether the episode failed: no value follows."""
    ended: bool
    """Whether the episode ended, by failure or by its time limit."""
    epsilon: float
    """Probability of a random action in this episode."""
    chance: float
    """Uniform random number in [0, 1) of this decision, for the learner's own use."""
    lane: int
    """Place of the episode among those that run side by side, 0 to 15; constant over an episode."""


class UpdateParams(NamedTuple):
    """Constants of an update; each is described in `equipoise.settings.LearningSettings`."""

    alpha_initial: float
    alpha_decay: float
    alpha_minimum: float
    trace_decay: float
    mirrored: bool


@inlined
def learning_rate(visits: float, params: UpdateParams) -> float:
    """Return alpha of a state-action pair after a number of visits."""
    rate = params.alpha_initial / (1.0 + params.alpha_decay * visits)
    return max(rate, params.alpha_minimum)


@inlined
def best_value(Q: Array, box: int) -> float:
    """Return the largest value of a box."""
    best = Q[box, 0]
    for i in range(1, Q.shape[1]):
        best = max(best, Q[box, i])
    return best


@inlined
def best_action(Q: Array, box: int, chance: float) -> int:
    """Return the action of the largest value of a box.

    Args:
        Q: State-action values, shape (270, 8).
        box: The box.
        chance: Uniform random number in [0, 1) that decides between equal values.
    """
    best = best_value(Q, box)
    ties = 0
    for i in range(Q.shape[1]):
        ties += Q[box, i] == best
    skip = int(ties * chance)
    action = 0
    for i in range(Q.shape[1]):
        if Q[box, i] == best:
            if skip == 0:
                action = i
            skip -= 1
    return action


@inlined
def write_mirrored(table: npt.NDArray[Any], box: int, action: int) -> None:
    """Copy an entry of a table to its mirror image."""
    table[mirrored_box(box), table.shape[1] - 1 - action] = table[box, action]


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


def epsilon_greedy(tables: Tables, box: int, epsilon: float, chance: float, choice: float) -> int:
    """Return a random action with probability epsilon, else the best one.

    Args:
        tables: Current tables.
        box: Box of the state.
        epsilon: Probability of a random action.
        chance: Uniform random number in [0, 1) that decides whether the action is random.
        choice: Uniform random number in [0, 1) that selects among several actions.
    """
    if chance < epsilon:
        return int(tables.Q.shape[1] * choice)
    return best_action(tables.Q, box, choice)


class Learner(NamedTuple):
    """A learning rule for a table."""

    update: Callable[[Tables, Transition, UpdateParams], None]
    """Learn from one decision: change `Tables` in place."""
    select: Callable[[Tables, int, float, float, float], int] = epsilon_greedy
    """Choose an action: called as `select(tables, box, epsilon, chance, choice)`."""
    tables: int = 0
    """Number of tables of the learner's own, 270 x 8 numbers each."""
    chooses_ahead: bool = False
    """Whether the next action a' is chosen before the update and passed to it."""


class LearnerKernel(NamedTuple):
    """Compiled learner and reward, as the episode loop takes them."""

    select: Any
    update: Any
    reward: Any
    chooses_ahead: bool


def new_tables(count: int) -> Tables:
    """Return tables of zeros, `count` of them the learner's own."""
    return Tables(
        Q=np.zeros((COUNT, ACTIONS)),
        visits=np.zeros((COUNT, ACTIONS), np.int64),
        own=np.zeros((count, COUNT, ACTIONS)),
    )


def select_signature() -> Any:
    """Return Numba's signature of `Learner.select`."""
    number = numba.float64
    return numba.int64(numba.typeof(new_tables(0)), numba.int64, number, number, number)


def update_signature() -> Any:
    """Return Numba's signature of `Learner.update`."""
    transition = Transition(0, 0, 0.0, 0.0, 0, 0, False, False, 0.0, 0.0, 0)
    params = UpdateParams(0.0, 0.0, 0.0, 0.0, False)
    return numba.void(*map(numba.typeof, (new_tables(0), transition, params)))
