"""Public arms as URDFs, and two libraries that read them.

`ARMS` pairs each arm with the URDF that the libraries read. The joints of the iiwas lie elsewhere
than in `equipoise.arm.iiwa`: the same robot by another hand.
"""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from equipoise import iiwa, read_urdf


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


DATA = Path(__file__).parents[1] / "data"
ELBOW = DATA / "elbow6.urdf"
ELBOW_HOME = (0.3, 0.4, 1.2, 0.5, -0.4, 0.2)
ARMS = {
    "iiwa7": (iiwa(7), (DATA / "iiwa7.urdf").read_text()),
    "iiwa14": (iiwa(14), (DATA / "iiwa14.urdf").read_text()),
    "elbow6": (read_urdf(ELBOW, home=ELBOW_HOME), ELBOW.read_text()),
}
GRAVITY = np.array([0.0, 0.0, -9.80665])


def by_pinocchio(urdf, q):
    robot = Pinocchio(urdf)
    robot.model.gravity.linear = GRAVITY
    configuration = robot.configuration(q)
    M = robot.pin.crba(robot.model, robot.data, configuration)
    torque = robot.pin.computeGeneralizedGravity(robot.model, robot.data, configuration)
    return np.triu(M) + np.triu(M, 1).T, torque
