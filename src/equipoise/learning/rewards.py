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

TRAVEL_COST: Final = 0.2
"""Cost of a step per squared distance from the middle, in `centred` [1/m^2]: 0.01 at the end of the
track, a hundredth of a failure. gamma = 0.99 sums up about a hundred steps."""
PHI_COST: Final = 0.27
"""Cost of a step per squared angle, in `centred` [1/rad^2]: 0.01 at the angle of failure."""
PERCUSSION: Final = 0.14
"""Distance I / (m l) from the pivot to the centre of percussion of the paper's pendulum [m]. A push
of the pivot leaves this point at rest, so that it moves smoothly while the arm moves to and fro."""
LOOK_AHEAD: Final = 0.7
"""Time over which `centred` continues the velocity of that point [s]. The boxes do not resolve
velocities below 0.5 m/s: without it, a table learns of a drift only at the end of the track."""


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


def centred(
    state: Observation, u: float, next_state: Observation, failed: bool, reward_failure: float
) -> float:
    """Return `paper`, less a small cost of an angle and of leaving the middle of the track."""
    if failed:
        return reward_failure
    place = next_state.x + PERCUSSION * next_state.phi
    velocity = next_state.x_dot + PERCUSSION * next_state.phi_dot
    ahead = place + LOOK_AHEAD * velocity
    return -TRAVEL_COST * ahead * ahead - PHI_COST * next_state.phi * next_state.phi
