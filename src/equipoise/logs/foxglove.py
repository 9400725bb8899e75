"""Messages that Foxglove and Lichtblick draw: joint states, transforms, description of the arm.

Their 3D panels take these schemas, by name, with JSON as encoding::

    /robot_description  std_msgs/String            URDF of arm and pendulum, once
    /tf                 foxglove.FrameTransforms   frame of each link, `RATE` times a second
    /joint_states       sensor_msgs/JointState     joint positions, as often

Frames are named as the links of the URDF, from `base` to `flange` and `pendulum`. Joints are shown
as measured, or as commanded where the log has no measurements; the pendulum as estimated, hanging
as long as no angle is known.
"""

from collections.abc import Iterator, Mapping, Sequence
from math import cos, pi, sin
from typing import Any, Final

from equipoise.model.arms.arm import Arm
from equipoise.model.arms.urdf_writer import PENDULUM, describe_links, write_urdf

RATE: Final = 25.0
"""Rate of transforms and joint states [Hz]: a film's."""
DIGITS: Final = 6
"""Number of decimals: micrometres and microradians."""

Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""


def _numbers(names: str) -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": "number"} for name in names}}


_STAMP: Final = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_TRANSFORM: Final = {
    "title": "foxglove.FrameTransform",
    "type": "object",
    "properties": {
        "timestamp": _STAMP,
        "parent_frame_id": {"type": "string"},
        "child_frame_id": {"type": "string"},
        "translation": _numbers("xyz"),
        "rotation": _numbers("xyzw"),
    },
}
_HEADER: Final = {
    "type": "object",
    "properties": {"stamp": _STAMP, "frame_id": {"type": "string"}},
}
_NUMBERS: Final = {"type": "array", "items": {"type": "number"}}
SCHEMAS: Final[Mapping[str, tuple[str, dict[str, Any]]]] = {
    "/robot_description": (
        "std_msgs/String",
        {"type": "object", "properties": {"data": {"type": "string"}}},
    ),
    "/tf": (
        "foxglove.FrameTransforms",
        {
            "title": "foxglove.FrameTransforms",
            "type": "object",
            "properties": {"transforms": {"type": "array", "items": _TRANSFORM}},
        },
    ),
    "/joint_states": (
        "sensor_msgs/JointState",
        {
            "type": "object",
            "properties": {
                "header": _HEADER,
                "name": {"type": "array", "items": {"type": "string"}},
                "position": _NUMBERS,
                "velocity": _NUMBERS,
                "effort": _NUMBERS,
            },
        },
    ),
}
"""Name and content of the schema of each topic."""


class ArmDisplay:
    """Source of the messages of one run, fed with its rows in the order of time."""

    def __init__(self, arm: Arm) -> None:
        """Describe the arm."""
        self.urdf: str = write_urdf(arm, pendulum=True)
        """URDF of arm and pendulum."""
        self._links = describe_links(arm, pendulum=True)
        self._names = [link.joint for link in self._links if link.turns]
        self._phi, self._measured, self._next, self._described = pi, False, 0, False

    def messages(
        self, table: str, row: Mapping[str, Any], stamp: int
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield topic and content of the messages due with a row.

        Args:
            table: Table of the row.
            row: Its content.
            stamp: Log time [ns].
        """
        if table == "tick":
            self._phi = row.get("estimated_phi", self._phi)
        q = row.get("q")
        if q is None or not (table == "reply" or (table == "tick" and not self._measured)):
            return
        self._measured = table == "reply"
        if stamp < self._next:
            return
        self._next = stamp + round(1e9 / RATE)
        if not self._described:
            self._described = True
            yield "/robot_description", {"data": self.urdf}
        angles = [round(angle, DIGITS) for angle in (*q, self._phi)]
        time = {"sec": stamp // 1_000_000_000, "nsec": stamp % 1_000_000_000}
        yield "/tf", {"transforms": list(self._transforms(angles, time))}
        yield (
            "/joint_states",
            {
                "header": {"stamp": time, "frame_id": "base"},
                "name": self._names,
                "position": angles,
                "velocity": [],
                "effort": [],
            },
        )

    def _transforms(self, angles: Sequence[float], time: Any) -> Iterator[dict[str, Any]]:
        angle = iter(angles)
        for link in self._links:
            turn = about(link.axis, next(angle)) if link.turns else (0.0, 0.0, 0.0, 1.0)
            rotation = product(from_rpy(link.rpy), turn)
            yield {
                "timestamp": time,
                "parent_frame_id": link.parent,
                "child_frame_id": link.name,
                "translation": _rounded("xyz", link.xyz),
                "rotation": _rounded("xyzw", rotation),
            }


def _rounded(names: str, values: Sequence[float]) -> dict[str, float]:
    return {name: round(value, DIGITS) for name, value in zip(names, values, strict=True)}


def about(axis: Sequence[float], angle: float) -> Quaternion:
    """Return the rotation by `angle` [rad] about an axis of length 1."""
    x, y, z = axis
    s = sin(0.5 * angle)
    return x * s, y * s, z * s, cos(0.5 * angle)


def from_rpy(rpy: Sequence[float]) -> Quaternion:
    """Return the rotation by roll, pitch and yaw [rad] about fixed axes."""
    x, y, z = (about(axis, angle) for axis, angle in zip(_AXES, rpy, strict=True))
    return product(z, product(y, x))


_AXES: Final = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation by `b`, then by `a`."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def urdf_attachment(urdf: str) -> dict[str, Any]:
    """Return the arguments of the attachment with a URDF."""
    return {"name": f"{PENDULUM}.urdf", "media_type": "application/xml", "data": urdf.encode()}
