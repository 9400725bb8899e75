"""Rewards by name, one function each.

A reward scores one step of an episode: `reward(state, u, next_state, failed) -> float`. Both states
are observations, with the fields x [m], x_dot [m/s], phi [rad] and phi_dot [rad/s]; u is
the acceleration [m/s^2]; `failed` says whether the step ended in failure.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from equipoise import paper

if TYPE_CHECKING:  # help lists the names without Numba
    from equipoise.control.policy import Observation


def failure(state: "Observation", u: float, next_state: "Observation", failed: bool) -> float:
    """Return -1 for a failure, else 0, the textbook's reward."""
    return -1.0 if failed else 0.0


def alive(state: "Observation", u: float, next_state: "Observation", failed: bool) -> float:
    """Return 1 for each step without a failure, as Gymnasium's CartPole does."""
    return 0.0 if failed else 1.0


def centred(state: "Observation", u: float, next_state: "Observation", failed: bool) -> float:
    """Return -1 for a failure, else at most -0.01 per axis for the distance from the middle."""
    if failed:
        return -1.0
    return -0.01 * ((next_state.x / paper.X_LIMIT) ** 2 + (next_state.phi / paper.PHI_LIMIT) ** 2)


REWARDS: Final[Mapping[str, Callable[["Observation", float, "Observation", bool], float]]] = {
    reward.__name__: reward for reward in (failure, alive, centred)
}
"""Rewards of the project by name, for `equipoise train --reward NAME`."""
