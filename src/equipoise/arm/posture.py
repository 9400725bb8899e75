"""Postures along the track, and the search for a home posture.

The flange moves along base x and keeps its orientation at home.
"""

import functools
from collections.abc import Sequence
from contextlib import suppress
from operator import itemgetter

import numpy as np

from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arrays import Array
from equipoise.errors import ArmError
from equipoise.paper import X_LIMIT


def along_x(arm: Arm, displacements: Sequence[float] | Array) -> Array:
    """Return the postures that carry the flange along base x from home, its orientation held.

    Damped Newton steps outwards from home, each posture the start of the next.

    Args:
        arm: The arm.
        displacements: x of the flange from home [m], shape (n,).

    Returns:
        Free joints [rad], shape (n, 6).

    Raises:
        ArmError: A place cannot be reached within the limits of the joints.
    """
    home = arm.kinematics(arm.home_free)
    places = [float(x) for x in displacements]
    postures: dict[float, Array] = {}
    for side in (1.0, -1.0):
        q = arm.home_free
        for x in sorted({x for x in places if x * side >= 0.0}, key=abs):
            q = postures[x] = _reach(arm, home.position + x * np.eye(3)[0], home.rotation, q)
    return np.array([postures[x] for x in places])


def condition(arm: Arm, q: Array) -> float:
    """Return the condition number of J (metres and radians) at the free joints `q` [rad]."""
    return float(np.linalg.cond(arm.kinematics(q).jacobian))


def limit_margin(arm: Arm, q: Array) -> float:
    """Return the distance to the nearest limit of a joint [rad] at the free joints `q` [rad]."""
    lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.free_joints]).T
    return float(np.minimum(q - lower, upper - q).min())


@functools.lru_cache(maxsize=16)
def search_home(arm: Arm) -> Arm:
    """Return `arm` with a home from which the whole track is far from singular postures.

    The candidates are 2000 random postures (seed 0) in the middle of the joints' ranges, with the
    flange at least 0.3 m above the base plane. Of the twenty best conditioned, the result has the
    best condition at its worst place on the track. The surroundings are not considered.

    Raises:
        ArmError: No candidate can carry the flange along the track.
    """
    rng = np.random.default_rng(0)
    ranges = np.clip([(joint.lower, joint.upper) for joint in arm.free_joints], -np.pi, np.pi)
    middle, half = ranges.mean(axis=1), 0.35 * np.ptp(ranges, axis=1)
    drawn = middle + half * rng.uniform(-1.0, 1.0, (2000, FREE_JOINTS))
    high = [q for q in drawn if arm.kinematics(q).position[2] > 0.3]
    candidates = list[tuple[float, Arm]]()
    for q in sorted(high, key=lambda q: condition(arm, q))[:20]:
        candidate = arm.model_copy(update={"home": tuple(arm.with_held(q).tolist())})
        with suppress(ArmError):
            track = along_x(candidate, np.linspace(-X_LIMIT, X_LIMIT, 5))
            worst = max(condition(candidate, posture) for posture in track)
            candidates.append((worst, candidate))
    if not candidates:
        raise ArmError(
            f"no posture found from which {arm.name} carries its flange {X_LIMIT} m both ways "
            "along base x; give a home posture"
        )
    return min(candidates, key=itemgetter(0))[1]


def _reach(arm: Arm, position: Array, rotation: Array, q: Array) -> Array:
    for _ in range(100):
        flange = arm.kinematics(q)
        turn = 0.5 * np.cross(flange.rotation, rotation, axis=0).sum(axis=1)
        error = np.concatenate([position - flange.position, turn])
        if np.abs(error).max() < 1e-10:
            break
        J = flange.jacobian
        # The damping prevents a division by zero in a singular posture.
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-9 * np.eye(6), error)
    else:
        raise ArmError(
            f"{arm.name} cannot carry its flange to {np.round(position, 3).tolist()} m with the "
            "orientation of home; give another home posture"
        )
    if limit_margin(arm, q) < 0.0:
        raise ArmError(
            f"{arm.name} leaves the limits of its joints with the flange at "
            f"{np.round(position, 3).tolist()} m: {np.round(np.degrees(q), 1).tolist()} degrees; "
            "give another home posture"
        )
    return q
