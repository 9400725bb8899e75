"""How fast the flange may move where setpoints come slowly.

The servo of a KST server goes towards each setpoint as soon as it comes, and the faster the further
away it is: where setpoints come seldom, joints move in steps, and the steps are faster than the
motion (`equipoise.model.actuator.shaped_peak`). The peaks have to stay below the speed at which the
cabinet stops the arm.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.model.actuator import speed_of_peak
from equipoise.model.arms.arm import FREE_JOINTS, Arm

Array = npt.NDArray[np.float64]

SHAPED_SHARE: Final = 0.8
"""Of a joint's speed limit: what the shaped peak of its velocity may reach."""
LINK_SPACING: Final = 0.005
"""Distance between two places of the track that are looked at [m]: the rates of the joints change
by 1 % from one to the next."""


def flange_speed(arm: Arm, period: float) -> float:
    """Return how fast the flange may go anywhere on its track, for each joint's shaped peak [m/s].

    Args:
        arm: The arm with its home posture.
        period: Longest time between two setpoints [s].
    """
    limits = [SHAPED_SHARE * joint.velocity for joint in arm.free_joints]
    allowed = np.array([speed_of_peak(limit, period) for limit in limits])
    return min(float(np.min(allowed / rates)) for rates in _rates_along_track(arm))


def _rates_along_track(arm: Arm) -> Iterator[Array]:
    """Yield by how much the free joints turn as the flange moves along x [rad/m], shape (6,)."""
    along_x = np.zeros(FREE_JOINTS)
    along_x[0] = 1.0

    def rates(q: Array) -> Array:
        return np.asarray(np.linalg.solve(arm.kinematics(q).jacobian, along_x), np.float64)

    for ahead in (LINK_SPACING, -LINK_SPACING):
        q = arm.home_free
        for _ in range(round(paper.X_LIMIT / LINK_SPACING) + 1):
            # A joint that does not move is never too fast.
            yield np.maximum(np.abs(rates(q)), np.finfo(np.float64).tiny)
            q = q + ahead * rates(q + 0.5 * ahead * rates(q))
