"""Interface of a learner, and the parts that learners share.

A `Learner` says how a table learns from one decision: the episode loop
(`equipoise.learning.episodes`) calls its `update` with a `Transition`. The paper's learner is
`equipoise.learning.q_learning`; a guest brings a `Learner`, or its `update` alone, as MODULE:NAME.

The function is compiled with Numba into one for a whole block (`learn_with`; `rewards_of` does it
with a reward), which is passed to the loop as a value (`equipoise.jit.function_pointer`): one
compiled loop serves every learner.
"""

import functools
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array, IntArray
from equipoise.control.control_step import OBS_PHI, OBS_PHI_DOT, OBS_X, OBS_X_DOT
from equipoise.control.controller import Observation
from equipoise.control.grid import ACTIONS, TRUNCATED, mirrored_box
from equipoise.jit import compilable, inlined
from equipoise.model.elementary import BATCH_SIZE, at


class Tables(NamedTuple):
    """Tables of a training, changed in place."""

    Q: Array
    """State-action values of the policy, shape (boxes, 8)."""
    visits: npt.NDArray[np.int64]
    """Number of updates of each value, shape (boxes, 8)."""
    own: Array
    """Tables of the learner's own, shape (`Learner.tables`, boxes, 8); zeros at the start."""


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
def best_action(Q: Array, box: int, chance: float) -> int:
    """Return the action of the largest value of a box.

    Args:
        Q: State-action values, shape (boxes, 8).
        box: The box.
        chance: Uniform random number in [0, 1) that decides between equal values.
    """
    best = best_value(Q, box)
    ties = 0
    for i in range(ACTIONS):
        ties += Q[box, i] == best
    skip = int(ties * chance)
    # Without branches: the action is the number of those before the chosen one.
    action, found = 0, 0
    for i in range(ACTIONS):
        found += Q[box, i] == best
        action += found <= skip
    return min(action, ACTIONS - 1)  # values that are not numbers have no best one


@inlined
def write_mirrored(table: npt.NDArray[Any], box: int, action: int) -> None:
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
def epsilon_greedy(Q: Array, box: int, epsilon: float, chance: float, choice: float) -> int:
    """Return a random action with probability epsilon, else the best one.

    Args:
        Q: State-action values, shape (boxes, 8).
        box: Box of the state.
        epsilon: Probability of a random action.
        chance: Uniform random number in [0, 1) that decides whether the action is random.
        choice: Uniform random number in [0, 1) that selects among several actions.
    """
    if chance < epsilon:
        return int(ACTIONS * choice)
    return best_action(Q, box, choice)


class Learner(NamedTuple):
    """A learning rule for a table."""

    update: Callable[[Tables, Transition, UpdateParams], None]
    """Learn from one decision: change `Tables` in place."""
    tables: int = 0
    """Number of tables of the learner's own."""


class Decisions(NamedTuple):
    """Decisions of the episodes that run side by side; all arrays have shape (BATCH_SIZE,)."""

    box: IntArray
    """Box of the decision."""
    action: IntArray
    """Index of the action, or `UNDECIDED`."""
    chance: Array
    """Uniform random number in [0, 1) of the decision, for the learner."""
    gained: Array
    """Discounted sum of the rewards since the decision."""
    discount: Array
    """gamma to the number of steps since the decision."""
    epsilon: Array
    """Probability of a random action in the episode."""
    place: IntArray
    """Index among the running episodes, constant over an episode."""


class Results(NamedTuple):
    """Results of a step in each lane, shape (BATCH_SIZE,) each."""

    reward: Array
    """Reward of the step."""
    box_next: IntArray
    """Box after the step."""
    outcome: IntArray
    """`CONTINUES`, `DECIDED`, `TIMED_OUT` or `FAILED`."""


UNDECIDED: Final = -1
"""Index of the action of an episode that has to choose one."""
CONTINUES: Final = 0
"""Outcome of a step: the action is held."""
DECIDED: Final = 1
"""The decision is complete, and the episode continues."""
TIMED_OUT: Final = 2
"""The decision is complete, and the episode has reached its time limit."""
FAILED: Final = 3
"""The decision is complete, and the episode has failed."""


class LearnerKernel(NamedTuple):
    """Compiled functions of a learner and a reward, each for all lanes of a block in one call."""

    learn: Any
    """`learn_with` a learner."""
    rewards: Any
    """`rewards_of` a reward."""


@functools.cache
def learn_with(update: Callable[..., None]) -> Callable[..., None]:
    """Return a function that learns from complete decisions, the last lane first.

    Args:
        update: `Learner.update`, callable in kernels.
    """

    def learn(
        tables: Tables,
        decisions: Decisions,
        results: Results,
        params: UpdateParams,
        lanes: int,
    ) -> None:
        box, action, chance, gained = (
            decisions.box,
            decisions.action,
            decisions.chance,
            decisions.gained,
        )
        discount, epsilon, place = decisions.discount, decisions.epsilon, decisions.place
        box_next, outcome = results.box_next, results.outcome
        for n in range(lanes - 1, -1, -1):
            if outcome[n] == CONTINUES:
                continue
            transition = Transition(
                box[n],
                action[n],
                gained[n],
                discount[n],
                box_next[n],
                outcome[n] == FAILED,
                outcome[n] != DECIDED,
                epsilon[n],
                chance[n],
                place[n],
            )
            update(tables, transition, params)
            box[n], action[n] = box_next[n], UNDECIDED
            discount[n], gained[n] = 1.0, 0.0

    return learn


@functools.cache
def rewards_of(reward: Callable[..., float]) -> Callable[..., None]:
    """Return a function that writes the rewards of a step.

    Args:
        reward: A reward of `equipoise.learning.rewards`, callable in kernels.
    """

    def rewards(
        before: Array,
        u: Array,
        after: Array,
        cause: IntArray,
        out: Array,
        lanes: int,
    ) -> None:
        for n in range(lanes):
            failed = cause[n] != TRUNCATED
            out[n] = reward(observed(before, n), u[n], observed(after, n), failed)

    return rewards


@inlined
def observed(block: Array, n: int) -> Observation:
    """Return the observation of lane `n`."""
    return Observation(
        at(block, OBS_X, n),
        at(block, OBS_X_DOT, n),
        at(block, OBS_PHI, n),
        at(block, OBS_PHI_DOT, n),
    )


def new_tables(boxes: int, own: int) -> Tables:
    """Return tables of zeros, `own` of them the learner's own."""
    return Tables(
        Q=np.zeros((boxes, ACTIONS)),
        visits=np.zeros((boxes, ACTIONS), np.int64),
        own=np.zeros((own, boxes, ACTIONS)),
    )


def new_decisions() -> Decisions:
    """Return the decisions of episodes that have not begun."""
    whole = np.zeros((3, BATCH_SIZE), np.int64)
    return Decisions(
        box=whole[0],
        action=whole[1],
        chance=np.zeros(BATCH_SIZE),
        gained=np.zeros(BATCH_SIZE),
        discount=np.ones(BATCH_SIZE),
        epsilon=np.zeros(BATCH_SIZE),
        place=np.arange(BATCH_SIZE),
    )


@compilable
def new_results() -> Results:
    """Return scratch for the results of a step."""
    return Results(
        np.zeros(BATCH_SIZE), np.zeros(BATCH_SIZE, np.int64), np.zeros(BATCH_SIZE, np.int64)
    )


def reward_signature() -> Any:
    """Return Numba's signature of a reward."""
    observation = numba.typeof(Observation(0.0, 0.0, 0.0, 0.0))
    return numba.float64(observation, numba.float64, observation, numba.boolean)


def update_signature() -> Any:
    """Return Numba's types of the arguments of `Learner.update`, whose result is ignored."""
    transition = Transition(0, 0, 0.0, 0.0, 0, False, False, 0.0, 0.0, 0)
    params = UpdateParams(0.0, 0.0, 0.0, False)
    return tuple(map(numba.typeof, (new_tables(1, 0), transition, params)))


def rewards_signature() -> Any:
    """Return Numba's signature of `LearnerKernel.rewards`."""
    array, whole = numba.float64[::1], numba.int64
    return numba.void(array, array, array, whole[::1], array, whole)


def learn_signature() -> Any:
    """Return Numba's signature of `LearnerKernel.learn`."""
    params = UpdateParams(0.0, 0.0, 0.0, False)
    given = new_tables(1, 0), new_decisions(), new_results(), params
    return numba.void(*map(numba.typeof, given), numba.int64)
