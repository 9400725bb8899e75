"""The iiwas as URDFs, typed from KUKA's public description, and two libraries that read them.

The joints lie elsewhere than in `equipoise.model.arms.iiwa` (half-way along the links and beside
them), some turn the other way round, and the flange is reached over a fixed joint: the same robot
by another hand. `ARMS` pairs each arm with the URDF that the libraries read.
"""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.urdf import read_urdf

AXES = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 1 0", "0 0 1")
ORIGINS = {
    7: (
        (0, 0, 0.1475),
        (0, -0.0105, 0.1925),
        (0, 0.0105, 0.2075),
        (0, 0.0105, 0.1925),
        (0, -0.0105, 0.2075),
        (0, -0.0707, 0.1925),
        (0, 0.0707, 0.091),
    ),
    14: (
        (0, 0, 0.1475),
        (0, -0.01, 0.2125),
        (0, 0.01, 0.228),
        (0, 0.0105, 0.192),
        (0, -0.0105, 0.2075),
        (0, -0.0707, 0.1925),
        (0, 0.0707, 0.091),
    ),
}
FLANGE = (0, 0, 0.035)

LINK = (
    '<link name="{}"><inertial><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="A{number}" type="revolute">'
    '<parent link="link{below}"/><child link="link{number}"/>'
    '<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
    '<limit lower="-2.9" upper="2.9" velocity="1.7" effort="100"/></joint>'
)


def iiwa_urdf(size: int) -> str:
    parts = [LINK.format(f"link{number}") for number in range(8)] + [LINK.format("flange")]
    for number, (origin, axis) in enumerate(zip(ORIGINS[size], AXES, strict=True), start=1):
        xyz = " ".join(str(part) for part in origin)
        parts.append(JOINT.format(number=number, below=number - 1, xyz=xyz, axis=axis))
    xyz = " ".join(str(part) for part in FLANGE)
    parts.append(
        '<joint name="plate" type="fixed"><parent link="link7"/><child link="flange"/>'
        f'<origin xyz="{xyz}"/></joint>'
    )
    return f'<robot name="iiwa{size}">{"".join(parts)}</robot>'


class Flange(NamedTuple):
    """What a library says of the flange; all joints of its model."""

    position: np.ndarray
    rotation: np.ndarray
    bias: np.ndarray
    jacobian: np.ndarray


class Pinocchio:
    def __init__(self, urdf: str) -> None:
        self.pin = pin = pytest.importorskip("pinocchio")
        self.model = pin.buildModelFromXML(urdf)
        self.data = self.model.createData()
        self.frame = self.model.getFrameId("flange")

    def configuration(self, q: np.ndarray) -> np.ndarray:
        """Continuous joints are stored as cosine and sine."""
        parts = []
        for joint, angle in zip(self.model.joints[1:], q, strict=True):
            parts += [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        return np.array(parts)

    def flange(self, q: np.ndarray, dq: np.ndarray) -> Flange:
        pin, model, data, frame = self.pin, self.model, self.data, self.frame
        aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        configuration = self.configuration(q)
        pin.forwardKinematics(model, data, configuration, dq, np.zeros(model.nv))
        pin.updateFramePlacements(model, data)
        bias = pin.getFrameClassicalAcceleration(model, data, frame, aligned).vector
        J = pin.computeFrameJacobian(model, data, configuration, frame, aligned)
        place = data.oMf[frame]
        return Flange(place.translation.copy(), place.rotation.copy(), bias.copy(), J.copy())


class MuJoCo:
    def __init__(self, urdf: str) -> None:
        keep_frames = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'
        self.model = mujoco.MjModel.from_xml_string(urdf.replace("</robot>", keep_frames))
        self.data = mujoco.MjData(self.model)
        self.body = self.model.body("flange").id

    def flange(self, q: np.ndarray, dq: np.ndarray) -> Flange:
        model, data, body = self.model, self.data, self.body
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)  # mj_jacDot reads what it leaves
        J, J_dot = np.zeros((6, model.nv)), np.zeros((6, model.nv))
        position = data.xpos[body].copy()
        mujoco.mj_jac(model, data, J[:3], J[3:], position, body)
        mujoco.mj_jacDot(model, data, J_dot[:3], J_dot[3:], position, body)
        return Flange(position, data.xmat[body].reshape(3, 3).copy(), J_dot @ dq, J)


ELBOW = Path(__file__).parents[2] / "data" / "elbow6.urdf"
ELBOW_HOME = (0.3, 0.4, 1.2, 0.5, -0.4, 0.2)
ARMS = {
    "iiwa7": (iiwa(7), iiwa_urdf(7)),
    "iiwa14": (iiwa(14), iiwa_urdf(14)),
    "elbow6": (read_urdf(ELBOW, home=ELBOW_HOME), ELBOW.read_text()),
}
