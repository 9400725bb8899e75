"""Clearance of an arm with a pendulum, by MuJoCo's distances between the drawn bodies."""

from typing import NamedTuple

import mujoco as mj
import numpy as np

from equipoise.model.arms.arm import Arm
from equipoise.model.arms.posture import along_x
from equipoise.model.arms.scene import SIZES, Sizes, scene
from equipoise.paper import X_LIMIT


class Clearance(NamedTuple):
    """Smallest distances over the track and a full turn of the pendulum; negative is overlap."""

    arm: float
    """Between parts of the arm, the bracket and the pendulum that are not joined [m]."""
    table: float
    """Between the table and all that moves [m]."""


class _Part(NamedTuple):
    """The drawing between two joints that are apart, with the housings at its root."""

    geoms: list[str]
    length: float
    radius: float


def clearance(
    arm: Arm, *, table_height: float = 0.0, sizes: Sizes = SIZES, track: float = X_LIMIT
) -> Clearance:
    """Return the smallest distances, flange anywhere within `track`, pendulum at any angle.

    Steps of 20 mm and 5 degrees.

    Args:
        arm: The arm.
        table_height: Top of the table above the arm's base plane [m].
        sizes: Thickness of the parts.
        track: Largest |x| [m].

    Raises:
        ArmError: The arm cannot reach the ends of the track.
    """
    spec = scene(arm, sizes)
    spec.geom("table").pos = [0.0, 0.0, table_height - 0.05]
    parts = _parts(arm, sizes, spec)
    model = spec.compile()
    data = mj.MjData(model)
    nowhere = np.zeros(6)

    def distance(some: _Part, others: list[_Part]) -> float:
        return min(
            mj.mj_geomDistance(model, data, model.geom(a).id, model.geom(b).id, 10.0, nowhere)
            for other in others
            for a in some.geoms
            for b in other.geoms
        )

    *body, rod = parts
    apart = [(part, _not_joined(i, body, sizes)) for i, part in enumerate(body)]
    table = _Part(["table"], 0.0, 0.0)
    closest, lowest = np.inf, np.inf
    for q in along_x(arm, np.linspace(-track, track, round(track / 0.01) + 1)):
        data.qpos[: len(arm.joints)] = arm.with_held(q)
        mj.mj_kinematics(model, data)
        closest = min([closest, *(distance(part, others) for part, others in apart if others)])
        lowest = min(lowest, distance(table, body[1:]))
        for phi in np.arange(0.0, 2.0 * np.pi, np.radians(5.0)):
            data.qpos[-1] = phi
            mj.mj_kinematics(model, data)
            closest = min(closest, distance(rod, body[:-1]))
            lowest = min(lowest, distance(table, [rod]))
    return Clearance(float(closest), float(lowest))


def _not_joined(i: int, parts: list[_Part], sizes: Sizes) -> list[_Part]:
    """Return the later parts that are kept from part `i` by more than their own thickness."""
    others: list[_Part] = []
    between = sizes.pulled_in
    for nearer, other in zip(parts[i + 1 :], parts[i + 2 :], strict=False):
        between += nearer.length
        if between > parts[i].radius + other.radius:
            others.append(other)
    return others


def _parts(arm: Arm, sizes: Sizes, spec: mj.MjSpec) -> list[_Part]:
    """Return the parts from the base to the pendulum."""
    steps = [joint.xyz for joint in arm.joints] + [arm.flange_xyz]
    lengths = {f"link {number}": np.linalg.norm(step) for number, step in enumerate(steps)}
    lengths |= {"bracket": np.linalg.norm(arm.pivot), "rod": sizes.rod_length}
    parts: list[_Part] = []
    housings: list[str] = []
    for geom in spec.geoms:
        if geom.name.startswith("housing"):
            housings.append(geom.name)
        elif geom.name != "table":
            part = _Part([geom.name, *housings], float(lengths[geom.name]), float(geom.size[0]))
            parts.append(part)
            housings = []
    return parts
