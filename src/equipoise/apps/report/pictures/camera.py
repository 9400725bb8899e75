"""Placement and projection of the camera beside the arm.

The camera stands behind the base, so that +x is to the *right* of the picture as in every figure.
It stands to the side, so that the arm does not hide the pendulum, and points down at the table.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Size = tuple[int, int]
"""Width and height [pixels]."""

AZIMUTH_DEG: Final = 42.0
"""Direction of view [deg]; 90 is along base +y, where the arm would hide the pendulum."""
ELEVATION_DEG: Final = -22.0
"""Elevation of the direction of view above the horizon [deg]."""
FOV_DEG: Final = 20.0
"""Vertical field of view [deg]; narrow, so that vertical edges look vertical."""


class Camera(NamedTuple):
    """Pose of the camera and size of its picture."""

    position: Floats
    """Position in the base frame [m], shape (3,)."""
    right: Floats
    """Unit vector to the right of the picture, shape (3,)."""
    up: Floats
    """Unit vector to the top of the picture, shape (3,)."""
    size: Size
    """Size of the picture."""

    def pixel(self, point: Floats) -> tuple[float, float]:
        """Project a point of the base frame: column from the left, row from the top [px]."""
        width, height = self.size
        offset = point - self.position
        ahead = offset @ np.cross(self.up, self.right)
        scale = 0.5 * height / (np.tan(np.radians(0.5 * FOV_DEG)) * ahead)
        column = 0.5 * width + scale * (offset @ self.right)
        return float(column), float(0.5 * height - scale * (offset @ self.up))


def nearest_camera(points: Floats, radii: Floats, size: Size) -> Camera:
    """Return the nearest camera with a ball around each point in its picture.

    A point at `a` to the right or up and `d` ahead of the base is in view of a camera at `a0` and
    `d0` if abs(a - a0) <= tan (d - d0), with the tangent of half the field of view. The upper and
    lower bounds together give the smallest -d0, with a0 midway between them.

    Args:
        points: Centres in the base frame [m], shape (n, 3).
        radii: Radii [m], shape (n,).
        size: Size of the picture.
    """
    azimuth, elevation = np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG)
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])
    up = np.cross(right, ahead)
    tangent = float(np.tan(np.radians(0.5 * FOV_DEG)))
    depths = points @ ahead
    position, distance = np.zeros(3), 0.0
    for direction, tan in ((right, tangent * size[0] / size[1]), (up, tangent)):
        offsets = points @ direction
        highest = np.max(offsets + radii - tan * depths)
        lowest = np.min(offsets - radii + tan * depths)
        position += 0.5 * (highest + lowest) * direction
        distance = max(distance, float(highest - lowest) / (2.0 * tan))
    return Camera(position - distance * ahead, right, up, size)
