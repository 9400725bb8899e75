"""Training in any simulated world, an episode after the other, as the paper trained in V-REP.

The rule of learning, its random numbers and the conditions of the episodes are those of the
compiled training (`equipoise.learning.episodes`); the steps are those of a `ClosedLoop`.
"""

from typing import Any

from equipoise.learning.episodes import (
    ENDED,
    TrainingState,
    begin_in_world,
    decide_in_world,
    learn_in_world,
)
from equipoise.worlds.interface import ClosedLoop, predicted
from equipoise.worlds.trials import Trial


def train_in_world(training: Any, state: TrainingState, loop: ClosedLoop, until: int) -> None:
    """Train until a number of episodes have ended.

    Args:
        training: The training, from `new_training_loop`; the next call continues from its state.
        state: Its state; no episode runs between two calls.
        loop: Closed loop of the world.
        until: Number of ended episodes at which to stop.
    """
    while state.totals[ENDED] < until:
        number, variation, start = begin_in_world(training)
        loop.reset(Trial(number, start, variation))
        goes_on = True
        while goes_on:
            u = decide_in_world(training, predicted(loop))
            cause = loop.step(u)
            goes_on = learn_in_world(training, predicted(loop), cause)
