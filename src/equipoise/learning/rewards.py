"""Rewards by name, one function each.

A reward scores one step of an episode: `reward(state, u, next_state, failed) -> float`. Both states
are observations, with the fields x [m], x_dot [m/s], phi [rad] and phi_dot [rad/s]; u is
the acceleration [m/s^2]; `failed` says whether the step ended in failure. A fifth parameter, if
there is one, receives the setting `learning.reward_failure`.

Every function of this file is a reward of that name, for `equipoise train --reward NAME`; a new one
needs no entry elsewhere.
"""

from equipoise.control.controller import Observation


def paper(
    state: Observation, u: float, next_state: Observation, failed: bool, reward_failure: float
) -> float:
    """Return the textbook reward, which the paper leaves open: only a failure costs."""
    return reward_failure if failed else 0.0


def alive(
    state: Observation, u: float, next_state: Observation, failed: bool, reward_failure: float
) -> float:
    """Return 1 for each step without a failure, as Gymnasium's CartPole does."""
    return 0.0 if failed else 1.0
