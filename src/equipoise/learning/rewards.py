"""Rewards by name, one function each.

A reward scores one step of an episode: `reward(state, u, next_state, failed) -> float`. Both states
are observations, with the fields x [m], x_dot [m/s], phi [rad] and phi_dot [rad/s]; u is
the acceleration [m/s^2]; `failed` says whether the step ended in failure.
"""

from collections.abc import Callable, Mapping
from typing import Final

from equipoise.control.controller import Observation


def paper(state: Observation, u: float, next_state: Observation, failed: bool) -> float:
    """Return the textbook reward, which the paper leaves open: only a failure costs, 1."""
    return -1.0 if failed else 0.0


def alive(state: Observation, u: float, next_state: Observation, failed: bool) -> float:
    """Return 1 for each step without a failure, as Gymnasium's CartPole does."""
    return 0.0 if failed else 1.0


REWARDS: Final[Mapping[str, Callable[[Observation, float, Observation, bool], float]]] = {
    "paper": paper,
    "alive": alive,
}
"""Rewards of the project by name, for `equipoise train --reward NAME`."""
