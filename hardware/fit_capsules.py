"""Fit capsules to the public meshes of an arm: python fit_capsules.py ARM FOLDER [ARM FOLDER ...].

Writes `capsules.json`, the only thing of those meshes that is kept here: for each link some
capsules that contain its surface, in the frame of the joint that moves it.

| arm | meshes in FOLDER, link by link | licence |
| --- | --- | --- |
| iiwa7, iiwa14 | `link_0.stl` to `link_7.stl`, of `lbr_description/meshes/ARM/collision` in
  github.com/lbr-stack/lbr_fri_ros2_stack; the whole arm in base coordinates, stretched upwards
  | Apache-2.0 |
| fr3 | `link0_coll.stl` to `link7_coll.stl`, of `franky_sim/assets/meshes` in franky-sim on PyPI,
  from github.com/frankarobotics/franka_description; each in its link's frame | Apache-2.0 |
"""

import json
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.cluster.vq import kmeans2
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, cKDTree

from clearance import link_frames
from equipoise.arm.urdf import read_arm

Array = npt.NDArray[np.float64]
MARGIN = 0.002
"""Added to each radius [m]: spacing of the points, and rounding."""
PIECES = (3, 4, 5, 6)
"""Numbers of capsules of a link that are tried."""
STARTS = 2
"""Random divisions of a link for each of them; the tightest capsules are kept."""


def to_segment(points: Array, a: Array, b: Array) -> Array:
    """Return the distances of points to a segment [m], shape (n,)."""
    along = b - a
    t = np.clip((points - a) @ along / max(along @ along, 1e-12), 0.0, 1.0)
    return np.linalg.norm(points - a - t[:, None] * along, axis=1)


def enclose(points: Array) -> Array:
    """Return a small capsule around points: both ends and radius [m], shape (7,)."""
    hull = points[ConvexHull(points).vertices]
    middle = hull.mean(axis=0)
    axes = np.linalg.svd(hull - middle)[2]

    def around(ends: Array) -> float:
        a, b = ends[:3], ends[3:]
        return volume(a, b, to_segment(hull, a, b).max())

    found = []
    for axis in axes:
        span = (hull - middle) @ axis
        across = np.linalg.norm(hull - middle - span[:, None] * axis, axis=1).max()
        low, high = span.min() + 0.7 * across, span.max() - 0.7 * across
        if low > high:
            low = high = 0.5 * (low + high)
        start = np.concatenate([middle + low * axis, middle + high * axis])
        options = {"maxiter": 1200, "xatol": 1e-5, "fatol": 1e-9}
        found.append(minimize(around, start, method="Nelder-Mead", options=options))
    ends = min(found, key=lambda one: one.fun).x
    return np.append(ends, to_segment(hull, ends[:3], ends[3:]).max())


def volume(a: Array, b: Array, r: float) -> float:
    """Return the volume of a capsule [m^3] with the ends of its axis and its radius."""
    return float(np.pi * r**2 * (np.linalg.norm(b - a) + 4.0 / 3.0 * r))


def protrusion(capsules: list[Array], points: Array) -> float:
    """Return the largest distance of the capsules' surface from the nearest of a link's points [m].

    Places inside another capsule are no surface.
    """
    tree, rng = cKDTree(points), np.random.default_rng(0)
    ball = rng.normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    worst = 0.0
    for number, one in enumerate(capsules):
        axis = one[3:6] - one[:3]
        along = rng.uniform(size=(400, 1)) * axis
        ends = np.where((ball @ axis)[:, None] > 0.0, axis, 0.0)
        across = ball - np.outer(ball @ axis, axis) / max(axis @ axis, 1e-12)
        across /= np.linalg.norm(across, axis=1)[:, None]
        skin = np.concatenate([ends + one[6] * ball, along + one[6] * across]) + one[:3]
        for other in capsules[:number] + capsules[number + 1 :]:
            skin = skin[to_segment(skin, other[:3], other[3:6]) > other[6]]
        if len(skin):
            worst = max(worst, float(tree.query(skin)[0].max()))
    return worst


def fit(mesh: Any) -> list[Array]:
    """Return capsules around a mesh [m], each of shape (7,)."""
    points = trimesh.sample.sample_surface(mesh, 4000, seed=0)[0]
    points = np.concatenate([points, mesh.vertices])
    found: list[list[Array]] = []
    for pieces, seed in product(PIECES, range(STARTS)):
        label = kmeans2(points, pieces, seed=seed, minit="++")[1]
        for last in (False, False, True):
            capsules = [enclose(points[label == k]) for k in range(pieces)]
            if last:
                break
            gaps = [to_segment(points, one[:3], one[3:6]) - one[6] for one in capsules]
            nearest = np.argmin(gaps, axis=0)
            if np.bincount(nearest, minlength=pieces).min() < 20:
                break  # a piece has nothing left: keep the last ones, which contain all
            label = nearest
        found.append(capsules)
    return min(found, key=lambda capsules: protrusion(capsules, points))


def read(arm: Any, folder: Path) -> list[Any]:
    """Return the meshes of an arm's links, base first, in the frames of their joints."""
    if not arm.name.startswith("iiwa"):
        return [trimesh.load(folder / f"link{number}_coll.stl") for number in range(8)]
    meshes, frames = [], link_frames(arm, np.zeros(7))
    for number, (place, rotation) in enumerate(frames):
        mesh: Any = trimesh.load(folder / f"link_{number}.stl")
        mesh.vertices = (mesh.vertices - place) @ rotation
        meshes.append(mesh)
    return meshes


def main() -> None:
    """Fit the capsules of the given arms, and keep those of the others."""
    file = Path(__file__).with_name("capsules.json")
    arms = json.loads(file.read_text()) if file.exists() else {}
    for name, folder in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        arm = read_arm(name)
        links = []
        for mesh in read(arm, Path(folder)):
            rounded = [np.round(one, 3) for one in fit(mesh)]
            links.append([[*one[:6].tolist(), round(float(one[6]) + MARGIN, 3)] for one in rounded])
        arms[name] = links
    lines = [
        f'"{name}": [\n' + ",\n".join(f" {json.dumps(link)}" for link in arms[name]) + "\n]"
        for name in sorted(arms)
    ]
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()
