"""Speed limit of the flange for slow streams of setpoints.

The servo of a KST server moves towards each setpoint on arrival, at a speed that grows with the
distance. With a slow stream the joints move in steps that are faster than the commanded motion
(`equipoise.model.actuator.speed_of_peak`). Their peaks must stay below the speed at which the
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
"""Maximum share of a joint's speed limit for the shaped peak of its velocity [-]."""
TRACK_STEP: Final = 0.005
"""Distance between two evaluated points of the track [m]; the rates of the joints change by 1 %
from one to the next."""


def flange_speed(arm: Arm, period: float) -> float:
    """Return the flange speed that brings a joint to its shaped peak, along the track [m/s].

    Args:
        arm: The arm with its home posture.
        period: Maximum time between two setpoints [s].
    """
    limits = [SHAPED_SHARE * joint.velocity for joint in arm.free_joints]
    allowed = np.array([speed_of_peak(limit, period) for limit in limits])
    return min(float(np.min(allowed / rates)) for rates in _rates_along_track(arm))


def _rates_along_track(arm: Arm) -> Iterator[Array]:
    """Yield the rates of the free joints per flange velocity along x [rad/m], shape (6,)."""
    along_x = np.zeros(FREE_JOINTS)
    along_x[0] = 1.0

    def rates(q: Array) -> Array:
        return np.asarray(np.linalg.solve(arm.kinematics(q).jacobian, along_x), np.float64)

    for ahead in (TRACK_STEP, -TRACK_STEP):
        q = arm.home_free
        for _ in range(round(paper.X_LIMIT / TRACK_STEP) + 1):
            # Avoids a division by zero for a joint that does not move.
            yield np.maximum(np.abs(rates(q)), np.finfo(np.float64).tiny)
            q = q + ahead * rates(q + 0.5 * ahead * rates(q))
