"""Messages for Foxglove and Lichtblick: transforms, and the description of the arm.

Their 3D panels read these schemas, by name, encoded as JSON::

    /robot_description  std_msgs/String            URDF of arm and pendulum, once
    /tf                 foxglove.FrameTransforms   frame of each link, `RATE` times a second

Frames have the names of the URDF's links, from `base` to `flange` and `pendulum`; each is placed in
`base`, by the kinematics of MuJoCo. Joint positions
are the measured ones, or the commanded ones in a log without measurements; the angle of the
pendulum is its estimate, before the first estimate that of a hanging pendulum.
"""

from collections.abc import Iterator, Mapping, Sequence
from math import pi
from typing import Any, Final

from equipoise.model.arms.arm import Arm
from equipoise.model.arms.scene import BASE, scene, write_urdf
from equipoise.model.physics_engine import mujoco

RATE: Final = 25.0
"""Rate of the transforms [Hz], that of a film."""
DIGITS: Final = 6
"""Number of decimals: micrometres and microradians."""


def _object(**fields: Any) -> dict[str, Any]:
    return {"type": "object", "properties": fields}


def _array(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}


_INTEGER, _NUMBER, _TEXT = ({"type": kind} for kind in ("integer", "number", "string"))
_TRANSFORM: Final = {
    "title": "foxglove.FrameTransform",
    **_object(
        timestamp={"title": "time", **_object(sec=_INTEGER, nsec=_INTEGER)},
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_object(**dict.fromkeys("xyz", _NUMBER)),
        rotation=_object(**dict.fromkeys("xyzw", _NUMBER)),
    ),
}
SCHEMAS: Final[Mapping[str, tuple[str, dict[str, Any]]]] = {
    "/robot_description": ("std_msgs/String", _object(data=_TEXT)),
    "/tf": (
        "foxglove.FrameTransforms",
        {"title": "foxglove.FrameTransforms", **_object(transforms=_array(_TRANSFORM))},
    ),
}
"""Name and content of the schema of each topic."""


class ArmDisplay:
    """Converter of the rows of one run, in the order of time, to messages."""

    def __init__(self, arm: Arm) -> None:
        """Describe the arm."""
        spec = scene(arm)
        self.urdf: str = write_urdf(spec)
        """URDF of arm and pendulum."""
        self._model = spec.compile()
        self._data = mujoco().MjData(self._model)
        self._links = [body.name for body in spec.bodies[1:]]
        self._phi, self._measured, self._next, self._described = pi, False, 0, False

    def messages(
        self, table: str, row: Mapping[str, Any], stamp: int
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield topic and content of the messages that are due at a row.

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

    def _transforms(self, angles: Sequence[float], time: Any) -> Iterator[dict[str, Any]]:
        data = self._data
        data.qpos[:] = angles
        mujoco().mj_kinematics(self._model, data)
        # The first body is the world.
        places, turns = data.xpos[1:].tolist(), data.xquat[1:].tolist()
        for link, place, (w, x, y, z) in zip(self._links, places, turns, strict=True):
            yield {
                "timestamp": time,
                "parent_frame_id": BASE,
                "child_frame_id": link,
                "translation": _rounded("xyz", place),
                "rotation": _rounded("xyzw", (x, y, z, w)),
            }


def _rounded(names: str, values: Sequence[float]) -> dict[str, float]:
    return {name: round(value, DIGITS) for name, value in zip(names, values, strict=True)}
