r"""Value iteration over the boxes, with probabilities counted in simulated episodes.

The boxes are taken for the states of a Markov decision process: N(s, a, s') counts how often action
a in box s led to box s' after one step, in simulated episodes behind the actuator. The table solves

.. math:: Q(s, a) = \sum_{s'} \frac{N(s, a, s')}{N(s, a)} \gamma \max_b Q(s', b)

with Q = -1 after a failure, the paper's reward, and for pairs that never occurred. Since a box
holds many states, the next box depends on more than s and a: the counts depend on the policy that
chose the actions. They are therefore added up over several rounds, each with the policy that the
counts before it give, and with random actions among its own. The tables of all rounds race.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control.grid import (
    ACTIONS,
    TRUNCATED,
    Grid,
    box_indices,
    greedy_actions,
    partition,
)
from equipoise.control.policy import LearningPoint, TabularPolicy
from equipoise.executors import Workers
from equipoise.learning.select import Candidate, Running, TrialPlant, race, trial_plants
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum
from equipoise.model.random import TRAINING_NOISE
from equipoise.settings import Settings
from equipoise.studies.table_search import LEVELS
from equipoise.worlds.fleet import new_fleet

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NAME: Final = "value_iteration"
"""Name of the method in the settings of its policy, in place of a learner's."""
FAILED: Final = -1.0
"""Value after a failure: the paper's reward."""
TOLERANCE: Final = 1e-10
"""Largest change of a value in the last sweep over the boxes."""


class CountSize(NamedTuple):
    """Effort of the counts."""

    rounds: int = 6
    """Number of rounds."""
    loops: int = 512
    """Number of closed loops side by side."""
    ticks: int = 2000
    """Number of steps of each loop in a round."""
    exploration: float = 0.3
    """Probability of a random action in the rounds after the first one, which is all random."""


QUICK: Final = CountSize(rounds=3, loops=64, ticks=500)
"""Effort of the short form."""


def solve_table(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    actuator: Actuator,
    size: CountSize | None = None,
    seed: int = 0,
    workers: Workers = 1,
    report: Callable[[LearningPoint], None] = lambda _: None,
    selecting: Running = lambda _, __: None,
) -> TabularPolicy:
    """Count transitions between boxes, and solve for the table.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings; of the section learning, the discount and the duration of an
            episode have an effect.
        actuator: Actuator of the arm.
        size: Effort; by default that of `CountSize`.
        seed: Master seed.
        workers: Threads, or an executor, of the race; the result does not depend on it.
        report: Called after each round.
        selecting: Called as trials of the race finish, with their number and the expected one.

    Returns:
        The table: its Q, the counts N(s, a) as visits, and the results of the race.
    """
    (plant,) = trial_plants(pendulum, arm, settings, (actuator,), seed)
    chosen, count = size or CountSize(), settings.boxes.count
    counts = _Counts(plant, chosen)
    table = np.zeros(count, np.int64)
    curve, tables = list[LearningPoint](), list[Array]()
    for number in range(chosen.rounds):
        curve.append(counts.advance(table, 1.0 if number == 0 else chosen.exploration))
        tables.append(solve(counts.N, settings.learning.gamma))
        table = greedy_actions(tables[-1])
        report(curve[-1])
    candidates = [
        Candidate(point.episodes, LEVELS[greedy_actions(Q)])
        for point, Q in zip(curve, tables, strict=True)
    ]
    order = race([plant], candidates, workers=workers, running=selecting)
    return TabularPolicy(
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in tables[order[0][0]].tolist()),
        visits=tuple(tuple(row) for row in counts.N.sum(axis=2).tolist()),
        h=paper.STEP,
        pendulum=pendulum,
        arm=arm,
        actuators=(actuator,),
        settings=settings.model_copy(
            update={"learning": settings.learning.model_copy(update={"learner": NAME})}
        ),
        seed=seed,
        learner=0,
        episodes=curve[-1].episodes,
        steps=curve[-1].steps,
        learning_curve=tuple(curve),
        checkpoints=tuple(result for _, result in order),
    )


def solve(N: IntArray, gamma: float) -> Array:
    """Solve for the values of all actions.

    The task is mirror-symmetric, and each count also counts for its mirror image.

    Args:
        N: Number of transitions from each box by each action to each box, shape
            (boxes, 8, boxes + 1); the last one is a failure.
        gamma: Discount of a step [-].

    Returns:
        Q, shape (boxes, 8).
    """
    both = N.astype(float)
    both[:, :, :-1] += N[::-1, ::-1, -2::-1]
    both[:, :, -1] += N[::-1, ::-1, -1]
    times = both.sum(axis=2)
    p = both / np.maximum(times, 1.0)[:, :, None]
    values = np.zeros(len(N))
    while True:
        Q = np.where(times > 0.0, gamma * p[:, :, :-1] @ values + FAILED * p[:, :, -1], FAILED)
        best = Q.max(axis=1)
        if np.max(np.abs(best - values)) < TOLERANCE:
            return Q
        values = best


class _Counts:
    """Transitions between boxes in closed loops that never stop."""

    def __init__(self, plant: TrialPlant, size: CountSize) -> None:
        settings, count = plant.settings, plant.settings.boxes.count
        self._size, self._boxes = size, partition(settings.boxes, plant.pendulum.k)
        self._simulation = plant.simulation(TRAINING_NOISE, settings.selection.spread)
        self._most = round(settings.learning.episode_duration / paper.STEP)
        self._fleet = new_fleet(self._simulation, size.loops, 1)
        self._rng = np.random.default_rng([plant.seed, TRAINING_NOISE])
        self._drawn = self._ended = self._steps = 0
        self.N = np.zeros((count, ACTIONS, count + 1), np.int64)
        """Number of transitions; the last column counts failures."""

    def advance(self, table: IntArray, exploration: float) -> LearningPoint:
        """Run a round with a table of actions, of which some are drawn at random instead."""
        loops, rng, count, before = self._size.loops, self._rng, len(table), self._ended
        self._release(np.arange(loops))
        box = self._box()
        for _ in range(self._size.ticks):
            action = table[box]
            explores = rng.random(loops) < exploration
            action[explores] = rng.integers(0, ACTIONS, np.count_nonzero(explores))
            self._fleet.step(LEVELS[action])
            failed = self._fleet.values.cause != TRUNCATED
            np.add.at(self.N, (box, action, np.where(failed, count, self._box())), 1)
            ended = np.flatnonzero(failed | (self._fleet.values.tick >= self._most))
            self._ended += len(ended)
            if len(ended):
                self._release(ended)
            box = self._box()
        steps = loops * self._size.ticks
        self._steps += steps
        duration = paper.STEP * steps / max(self._ended - before, 1)
        return LearningPoint(episodes=self._ended, steps=self._steps, duration=duration)

    def _release(self, loops: IntArray) -> None:
        trials = self._simulation.draw(len(loops), self._drawn)
        self._drawn += len(loops)
        self._fleet.reset(loops, trials)

    def _box(self) -> IntArray:
        return _boxes_of(self._fleet.values.predicted, self._boxes)


def _boxes_of(states: Array, boxes: Grid) -> IntArray:
    found: IntArray = box_indices(states, boxes)
    return found
