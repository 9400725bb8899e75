"""Rewards by name, one function each.

A reward scores one step of an episode: `reward(state, u, next_state, failed) -> float`. Both states
are observations, with the fields x [m], x_dot [m/s], phi [rad] and phi_dot [rad/s]; u is
the acceleration [m/s^2]; `failed` says whether the step ended in failure. A fifth parameter, if
there is one, receives the setting `learning.reward_failure`.

Every function of this file is a reward of that name, for `equipoise train --reward NAME`; a new one
needs no entry elsewhere.
"""

from typing import Final

from equipoise.control.controller import Observation

X_COST: Final = 0.2
"""Cost of a step per squared displacement, in `centred` [1/m^2]: 0.01 at the end of the track, so
that no future of such steps, discounted by 0.97, costs as much as a failure."""
PHI_COST: Final = 0.27
"""Cost of a step per squared angle, in `centred` [1/rad^2]: 0.01 at the angle of failure."""


def paper(
    state: Observation, u: float, next_state: Observation, failed: bool, reward_failure: float
) -> float:
    """Return the paper's reward: a failure costs, every other step gives nothing."""
    return reward_failure if failed else 0.0


def alive(
    state: Observation, u: float, next_state: Observation, failed: bool, reward_failure: float
) -> float:
    """Return 1 for each step without a failure, as Gymnasium's CartPole does."""
    return 0.0 if failed else 1.0


def centred(
    state: Observation, u: float, next_state: Observation, failed: bool, reward_failure: float
) -> float:
    """Return the paper's reward, less a small cost of being off the middle or off upright."""
    if failed:
        return reward_failure
    return -X_COST * next_state.x**2 - PHI_COST * next_state.phi**2
