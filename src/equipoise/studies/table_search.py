r"""Search for the best table over a partition: the bound of what a table of these boxes can do.

A box holds many states, so that the next box depends on more than box and action: value iteration
over the boxes (`equipoise.studies.value_iteration`) solves another problem. The search needs no
model. It maximises what the selection of a training maximises, the score of compiled trials
(`equipoise.settings.SelectionSettings`), on plants that vary more than there, by the cross-entropy
method (Rubinstein 1999): sample tables, keep the best ones, and move the probability of each action
in each box towards theirs,

.. math:: p_s(a) = (1 - \beta) p_s(a) + \beta \frac{\text{elite tables with } a \text{ in } s}
    {\text{elite tables}}

All tables of a generation run the same trials (common random numbers), and each generation new
ones. Tables are mirror-symmetric, as the task is. The search begins at the best of several tables:
LQR at the centre of each box, and those that a caller gives, such as learned ones. In the end they
race with the tables of the search, so that the result scores at least as well as they do, up to the
error of the race.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise, product
from math import radians
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control.baselines import lqr_gains
from equipoise.control.grid import ACTIONS, TRUNCATED
from equipoise.control.policy import Checkpoint, LearningPoint, TabularPolicy
from equipoise.errors import InputError
from equipoise.executors import Workers
from equipoise.learning.select import (
    FIRST_BLOCK,
    Candidate,
    Running,
    TrialPlant,
    race,
    scored,
    trial_plants,
)
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import SELECTION
from equipoise.settings import BoxSettings, Settings

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NAME: Final = "table_search"
"""Name of the search in the settings of its policy, in place of a learner's."""
LEVELS: Final = np.array(paper.ACTIONS)
"""Accelerations of the actions [m/s^2], shape (8,), rising."""
OUTER: Final = 1.5
"""Outer end of the intervals without a limit, phi_dot and x_dot, in units of their last inner
end."""


class SearchSize(NamedTuple):
    """Effort of a search."""

    generations: int = 40
    """Number of generations."""
    tables: int = 128
    """Number of tables of a generation."""
    trials: int = 8
    """Number of common trials of a generation."""
    elite: float = 1.0 / 6.0
    """Share of the best tables of a generation."""
    smoothing: float = 0.3
    """Weight beta of the elite tables in the new probabilities."""
    width: float = 0.42
    """Standard deviation of the first probabilities about the start, in actions of 0.5 m/s^2: one
    box in ten differs."""
    spread: float = 3.0
    """Factor on the variation of the plants, also in the races: with the 1.25 of a training's
    selection nearly no trial of a good table fails, and the search would trade robustness for a
    smaller rms(x)."""


QUICK: Final = SearchSize(generations=8, tables=32, trials=4)
"""Effort of a short search."""


def lqr_table(settings: BoxSettings, pendulum: PendulumParameters) -> Array:
    """Return the table of LQR, snapped to the actions, at the centre of each box.

    Args:
        settings: The boxes.
        pendulum: Nominal parameters.

    Returns:
        Acceleration of each box [m/s^2], shape (boxes,), mirror-symmetric.
    """

    def centres(ends: Sequence[float], limit: float) -> list[float]:
        return [0.5 * (low + high) for low, high in pairwise((-limit, *ends, limit))]

    gains = lqr_gains(pendulum, paper.STEP)
    rates, speeds = settings.phi_dot_deg, settings.x_dot
    axes = (
        [radians(angle) for angle in centres(settings.phi_deg, paper.PHI_LIMIT_DEG)],
        [radians(rate) for rate in centres(rates, OUTER * rates[-1])],
        centres(settings.x, paper.X_LIMIT),
        centres(speeds, OUTER * speeds[-1]),
    )
    half: list[int] = []
    for phi, phi_dot, ahead, x_dot in list(product(*axes))[: settings.count // 2]:
        x = ahead - settings.look_ahead * (x_dot + phi_dot / pendulum.k)
        u = float(np.dot(gains, (x, x_dot, phi, phi_dot)))
        half.append(int(np.argmin(np.abs(LEVELS - u))))
    return LEVELS[whole_table(np.array(half))]


def whole_table(half: IntArray) -> IntArray:
    """Return the actions of all boxes from those of the lower half, shape (..., boxes / 2)."""
    return np.concatenate((half, ACTIONS - 1 - half[..., ::-1]), axis=-1)


def search_table(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    actuator: Actuator,
    starts: Sequence[Array] = (),
    size: SearchSize | None = None,
    seed: int = 0,
    workers: Workers = 1,
    report: Callable[[LearningPoint], None] = lambda _: None,
    selecting: Running = lambda _, __: None,
) -> TabularPolicy:
    """Search for the best table of a partition.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings; as in `equipoise.train`, the section learning has no effect.
        actuator: Actuator of the arm.
        starts: Further tables to begin with, accelerations of each box [m/s^2], shape (boxes,).
        size: Effort; by default that of `SearchSize`.
        seed: Master seed.
        workers: Threads, or an executor; the result does not depend on it.
        report: Called after each generation with the number of trials in place of episodes.
        selecting: Called as trials of the race finish, with their number and the expected one.

    Returns:
        The table: Q is 1 for the action of a box and 0 for the others, visits are 0, and episodes
        are trials of the search.

    Raises:
        InputError: A start has another number of boxes.
    """
    effort = size or SearchSize()
    harder = settings.model_copy(
        update={"selection": settings.selection.model_copy(update={"spread": effort.spread})}
    )
    (plant,) = trial_plants(pendulum, arm, harder, (actuator,), seed)
    begun = [lqr_table(settings.boxes, plant.pendulum), *starts]
    if any(len(start) != settings.boxes.count for start in begun):
        raise InputError(
            f"a table to begin with has {[len(start) for start in begun]} boxes, expected "
            f"{settings.boxes.count}; give tables of the same boxes"
        )
    order = race([plant], [Candidate(0, start) for start in begun], workers=workers)
    search = _Search(plant, effort, begun[order[0][0]], workers)
    curve: list[LearningPoint] = []
    for _ in range(effort.generations):
        curve.append(search.advance())
        report(curve[-1])
    candidates = [*(Candidate(0, start) for start in begun), *search.candidates]
    final = race([plant], candidates, workers=workers, running=selecting)
    chosen = candidates[final[0][0]].u_of_box
    return TabularPolicy(
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in (chosen[:, None] == LEVELS).astype(float).tolist()),
        visits=((0,) * ACTIONS,) * len(chosen),
        h=paper.STEP,
        pendulum=pendulum,
        arm=arm,
        actuators=(actuator,),
        settings=settings.model_copy(
            update={"learning": settings.learning.model_copy(update={"learner": NAME})}
        ),
        seed=seed,
        learner=0,
        episodes=search.trials,
        steps=search.steps,
        learning_curve=tuple(curve),
        checkpoints=tuple(result for _, result in final),
    )


class _Search:
    """Probabilities of the actions in each box of the lower half, and their course."""

    def __init__(self, plant: TrialPlant, size: SearchSize, start: Array, workers: Workers) -> None:
        self._plant, self._size, self._workers = plant, size, workers
        self._simulation = plant.simulation(SELECTION, plant.settings.selection.spread)
        self._rng = np.random.default_rng([plant.seed, SELECTION])
        half = np.searchsorted(LEVELS, start)[: len(start) // 2]
        distance = (np.arange(ACTIONS) - half[:, None]) / size.width
        self._p = np.exp(-0.5 * distance**2)
        self._p /= self._p.sum(axis=1, keepdims=True)
        # The races run trials with lower numbers.
        rounds = plant.settings.selection.rounds
        self._next = FIRST_BLOCK * 2 ** (rounds - 1)
        self.trials, self.steps = 0, 0
        self._modes: dict[bytes, Candidate] = {}

    @property
    def candidates(self) -> list[Candidate]:
        """Most probable table after each generation, equal ones once."""
        return list(self._modes.values())

    def advance(self) -> LearningPoint:
        """Run a generation; return the number of trials and steps, and the mean duration."""
        size, p = self._size, self._p
        chances = self._rng.random((size.tables, len(p), 1))
        halves = np.minimum((chances > p.cumsum(axis=1)).sum(axis=2), ACTIONS - 1)
        halves[0] = p.argmax(axis=1)
        results = self._run(halves)
        best = np.argsort([-result.score for result in results], kind="stable")
        elite = halves[best[: max(1, round(size.elite * size.tables))]]
        share = (elite[:, :, None] == np.arange(ACTIONS)).mean(axis=0)
        self._p = (1.0 - size.smoothing) * p + size.smoothing * share
        mode = LEVELS[whole_table(self._p.argmax(axis=1))]
        self._modes.setdefault(mode.tobytes(), Candidate(self.trials, mode))
        mean = float(np.mean([result.mean_duration for result in results]))
        return LearningPoint(episodes=self.trials, steps=self.steps, duration=mean)

    def _run(self, halves: IntArray) -> list[Checkpoint]:
        """Run the common trials of a generation; return the result of each table."""
        size, duration = self._size, self._plant.settings.selection.duration
        policy = self._plant.tables(LEVELS[whole_table(halves)].ravel())
        trials = self._simulation.draw(size.trials, self._next).of_tables(range(len(halves)))
        rows, workers = range(len(trials.steps)), self._workers
        self._simulation.run(policy, trials, rows, duration=duration, workers=workers)
        self._next += size.trials
        self.trials += len(rows)
        self.steps += int(trials.steps.sum())
        shape = len(halves), size.trials
        columns: Any = (trials.cause == TRUNCATED, trials.steps, trials.sum_x2)
        each = zip(*(column.reshape(shape) for column in columns), strict=True)
        return [
            scored(self._plant, self.trials, int(lasted.sum()), steps, sum_x2)
            for lasted, steps, sum_x2 in each
        ]
