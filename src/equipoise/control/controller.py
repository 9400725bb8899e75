"""Controller of one arm for Python: the kernels of the training, on one lane.

`Controller` writes measurements into the lane's state, calls `observe` and `command` of
`equipoise.control.control_step`, and reads their results from there.
"""

from collections.abc import Sequence
from math import asin, sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.control.boxes import box_index, partition
from equipoise.control.clik import manipulability
from equipoise.control.control_step import (
    SETPOINTS_PER_TICK,
    ControllerParams,
    command,
    new_controller_state,
    observe,
    start_controller,
)
from equipoise.control.policy import Policy
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.arms.compiler import FRAME_SIZE, POSITION, ROTATION, TWIST, KinematicsFunction
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.settings import BoxSettings

Array = npt.NDArray[np.float64]


class Observation(NamedTuple):
    """Observation of the policy."""

    x: float
    """Displacement of the flange from home [m]."""
    x_dot: float
    """Its velocity [m/s]."""
    phi: float
    """Angle of the pendulum from upright [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""


class StateEstimate(NamedTuple):
    """Estimate of the observer at the tick."""

    phi: float
    """Angle of the pendulum from upright [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""
    bias: float
    """Encoder zero offset [rad]."""
    v: float
    """Velocity of the pivot along x [m/s]."""
    x: float
    """Displacement of the flange from home [m]."""


class Controller:
    """A controller with its state."""

    def __init__(self, arm: Arm, controller: ControllerParams, boxes: BoxSettings) -> None:
        """Begin at home, at rest."""
        self._arm, self._controller = arm, controller
        self._boxes = partition(boxes, controller.pendulum.k)
        self._state = new_controller_state()
        self._free = list(arm.free)
        self._home_x = float(controller.home_reference[POSITION])
        self.begin(0.0, 0.0)

    def begin(self, phi: float, phi_dot: float) -> None:
        """Begin at home, at rest, with the measured pendulum [rad], [rad/s]."""
        start_controller(self._controller, self._state, 0.0, 0.0, phi, phi_dot, 0)

    def observe(
        self, counts: float, encoder_age: float, q: Sequence[float], reply_age: float
    ) -> None:
        """Compute the observation from the measurements of a tick.

        Args:
            counts: Encoder counts from hanging, growing with theta.
            encoder_age: Age of the counts [s].
            q: Measured joints, all of them [rad].
            reply_age: Age of the joints [s].
        """
        self._state.counts[0] = counts
        self._state.measured[::BATCH_SIZE] = [q[joint] for joint in self._free]
        observe(self._controller, self._state, encoder_age, reply_age, 1)

    @property
    def observation(self) -> Observation:
        """Observation of the policy."""
        return Observation(*self._state.observation[::BATCH_SIZE].tolist())

    @property
    def estimate(self) -> StateEstimate:
        """Estimate of the observer."""
        return StateEstimate(*self._state.estimate[::BATCH_SIZE].tolist())

    def decide(self, policy: Policy) -> float:
        """Return the policy's u [m/s^2] for the observation."""
        return policy.act(np.array(self.observation))

    @property
    def box(self) -> int:
        """Box of the observation."""
        return int(box_index(*self.observation, self._boxes))

    def command(self, u: float) -> tuple[tuple[float, ...], ...]:
        """Accelerate the flange by u [m/s^2] over a tick, and return its setpoints [rad]."""
        self._state.u[0] = u
        command(self._controller, self._state, 1)
        setpoints = self._state.setpoints.reshape(SETPOINTS_PER_TICK, -1)
        return tuple(self._all_joints(self._arm.home, setpoint) for setpoint in setpoints)

    @property
    def limit_exceeded(self) -> bool:
        """Whether the last command exceeded a limit of a joint."""
        return bool(self._state.limit_exceeded[0])

    @property
    def q(self) -> tuple[float, ...]:
        """Commanded joints at the end of the tick, all of them [rad]."""
        return self._all_joints(self._arm.home, self._state.q)

    @property
    def dq(self) -> tuple[float, ...]:
        """Their velocities [rad/s]."""
        return self._all_joints((0.0,) * len(self._arm.joints), self._state.dq)

    @property
    def x(self) -> float:
        """Commanded displacement of the flange at the end of the tick [m]."""
        return float(self._state.frame[POSITION * BATCH_SIZE]) - self._home_x

    @property
    def x_dot(self) -> float:
        """Its velocity [m/s]."""
        return float(self._state.frame[TWIST * BATCH_SIZE])

    def _all_joints(self, held: Sequence[float], free: Array) -> tuple[float, ...]:
        """Return `held` with the free joints of a block."""
        joints = np.array(held, np.float64)
        joints[self._free] = free[::BATCH_SIZE]
        return tuple(joints.tolist())


class FlangePose(NamedTuple):
    """Pose of the flange, from measured joints."""

    x: float
    """Displacement from home along base x [m]."""
    drift: float
    """Distance from the line through home [m]."""
    tilt: float
    """Angle from its orientation at home [rad]."""
    manipulability: float
    """|det J| [m^3]."""


class FlangeKinematics:
    """Forward kinematics of measured joints, for the safety rules."""

    def __init__(self, arm: Arm, controller: ControllerParams) -> None:
        """Allocate the blocks of a pose."""
        self._controller, self._free = controller, list(arm.free)
        self._q, self._dq = np.zeros(FREE_JOINTS * BATCH_SIZE), np.zeros(FREE_JOINTS * BATCH_SIZE)
        self._frame = np.zeros(FRAME_SIZE * BATCH_SIZE)

    def pose(self, q: Sequence[float]) -> FlangePose:
        """Return the pose of the flange at measured joints, all of them [rad]."""
        self._q[::BATCH_SIZE] = [q[joint] for joint in self._free]
        kinematics, home = self._controller.kinematics, self._controller.home_reference
        return FlangePose(
            *map(float, flange_pose(kinematics, self._q, self._dq, self._frame, home))
        )


@kernel
def flange_pose(
    kinematics: KinematicsFunction, q: Array, dq: Array, frame: Array, home: Array
) -> tuple[float, float, float, float]:
    """Return the entries of `FlangePose`, for the first lane of a block of joints.

    Args:
        kinematics: Kinematics of the arm.
        q: Free joints [rad], a block of 6 rows.
        dq: Zero, a block of 6 rows.
        frame: Scratch for the record.
        home: Pose of the flange at home, shape (24,).
    """
    kinematics(q, dq, frame, 1)
    x = at(frame, POSITION, 0) - home[POSITION]
    y = at(frame, POSITION + 1, 0) - home[POSITION + 1]
    z = at(frame, POSITION + 2, 0) - home[POSITION + 2]
    trace = 0.0
    for i in range(9):
        trace += at(frame, ROTATION + i, 0) * home[ROTATION + i]
    # 1 - cos of the angle, from the trace of the rotation between them.
    away = min(max(0.5 * (3.0 - trace), 0.0), 2.0)
    return x, sqrt(y * y + z * z), 2.0 * asin(sqrt(0.5 * away)), abs(manipulability(frame, 0))
