"""Clearance of the pendulum's whole turn at every place of the track, to arm and table.

Arms are the capsules of `capsules.json`, which contain their links; the pendulum is two capsules
that contain rod and hub. The holder is the points of its surface: it may come near every link but
the last one, on which it sits.
"""

import json
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from design import MM
from equipoise.arm.arm import Arm
from equipoise.arm.posture import along_x
from equipoise.arm.scene import scene
from equipoise.paper import X_LIMIT
from mechanism import Mechanism

Array = npt.NDArray[np.float64]

CAPSULES: Final = Path(__file__).with_name("capsules.json")
LEAST: Final = 0.020
"""Least clearance that is asked for [m]."""
TURN: Final = np.radians(np.arange(0.0, 360.0, 5.0))
"""Angles of the pendulum from upright [rad]."""
TRACK: Final = np.linspace(-X_LIMIT, X_LIMIT, 23)
"""Displacements of the flange [m]."""


def link_frames(arm: Arm, q: Array) -> list[tuple[Array, Array]]:
    """Return place [m] and rotation of the base and of every joint's frame, base first."""
    model = scene(arm).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = [*q, np.pi]
    mujoco.mj_kinematics(model, data)
    names = ["world", *(f"frame {number}" for number in range(1, len(arm.joints) + 1))]
    bodies = [data.body(name) for name in names]
    return [(np.array(one.xpos), np.array(one.xmat).reshape(3, 3)) for one in bodies]


def between_segments(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Return the distances of one segment to several [m], shape (n,).

    Args:
        a0: Start of the segment, shape (3,).
        a1: Its end.
        b0: Starts of the others, shape (n, 3).
        b1: Their ends.
    """
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    a, b, c = u @ u, v @ u, np.maximum(np.sum(v * v, axis=1), 1e-12)
    d, e = w @ u, np.sum(v * w, axis=1)
    det = a * c - b * b
    s = np.clip(np.where(det > 1e-12, (b * e - c * d) / np.maximum(det, 1e-12), 0.0), 0.0, 1.0)
    t = np.clip((b * s + e) / c, 0.0, 1.0)
    s = np.clip((b * t - d) / a, 0.0, 1.0)
    return np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)


class Clearance(NamedTuple):
    """Clearances of the mechanism on one arm."""

    turn: Array
    """Pendulum to arm [m]: rows of the track, columns of the turn."""
    table: float
    """Lowest point of the turn over the table [m]."""
    holder: float
    """Holder to the links before the last one, at every place of the track [m]."""

    @property
    def least(self) -> float:
        """Least of all [m]."""
        return min(float(self.turn.min()), self.table, self.holder)


def clearance(arm: Arm, mechanism: Mechanism, flange_height: float = 0.0) -> Clearance:
    """Return the clearances of a mechanism on an arm.

    Args:
        arm: The arm, of `capsules.json`, at home with its own pivot's direction.
        mechanism: The mechanism.
        flange_height: Height of a media flange between arm and base [m].
    """
    links = json.loads(CAPSULES.read_text())[arm.name]
    d, points = mechanism.design, surface(mechanism)
    to_flange = base_rotation(arm)
    down = np.array([0.0, 0.0, flange_height])
    pivot = to_flange @ mechanism.pivot + down
    points = points @ to_flange.T + down
    spindle_ends = np.array([d.hub_start - d.hub_boss, d.pivot_outward + d.hub_rod_ear]) * MM
    hub_x = 0.5 * spindle_ends.sum() - d.pivot_outward * MM
    hub_r = float(np.hypot(0.5 * np.diff(spindle_ends)[0], 0.5 * d.hub_width * MM))
    pieces = (
        (0.0, d.rod_start, d.rod_start + mechanism.rod_length, 0.5 * d.rod * MM),
        (hub_x, -d.hub_back, d.hub_end, hub_r),
    )
    rows: list[list[float]] = []
    table, holder = np.inf, np.inf
    for free in along_x(arm, TRACK):
        q = arm.with_held(free)
        ends: list[tuple[Array, Array, float, int]] = []
        for number, (place, rotation) in enumerate(link_frames(arm, q)):
            for *numbers, radius in links[number]:
                a, b = np.array(numbers[:3]), np.array(numbers[3:])
                ends.append((place + rotation @ a, place + rotation @ b, radius, number))
        b0, b1 = np.array([e[0] for e in ends]), np.array([e[1] for e in ends])
        radii, number = np.array([e[2] for e in ends]), np.array([e[3] for e in ends])
        flange = arm.kinematics(free)
        centre = flange.position + flange.rotation @ pivot
        outward = flange.rotation @ to_flange @ [1.0, 0.0, 0.0]
        row = []
        for phi in TURN:
            along = np.array([np.sin(phi), 0.0, np.cos(phi)])
            gaps = [
                np.min(
                    between_segments(
                        centre + side * outward + start * MM * along,
                        centre + side * outward + end * MM * along,
                        b0,
                        b1,
                    )
                    - radii
                )
                - radius
                for side, start, end, radius in pieces
            ]
            row.append(float(min(gaps)))
        rows.append(row)
        table = min(table, float(centre[2] - mechanism.reach))
        before = number < len(links) - 1
        own = flange.position + points @ flange.rotation.T
        for a, b, radius in zip(b0[before], b1[before], radii[before], strict=True):
            t = np.clip((own - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0.0, 1.0)
            gap = np.linalg.norm(own - a - t[:, None] * (b - a), axis=1).min() - radius
            holder = min(holder, float(gap))
    return Clearance(np.array(rows), table, holder)


def base_rotation(arm: Arm) -> Array:
    """Return the rotation from the frame of the parts to the flange's, about the flange's axis."""
    x, y, _ = arm.pivot
    c, s = np.array([x, y]) / np.hypot(x, y)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def surface(mechanism: Mechanism) -> Array:
    """Return points of the holder's surface in the frame of the parts [m], shape (n, 3)."""
    names = ("base", "bearing_block", "encoder_plate", "encoder")
    points: list[Any] = []
    for name in names:
        vertices, _ = mechanism.solids[name].tessellate(0.2, 0.3)
        points += [tuple(vertex) for vertex in vertices]
    return np.array(points) * MM
