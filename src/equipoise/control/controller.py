"""The controller of one arm, as Python drives it: the kernels of the training, on one lane.

Nothing is computed here: measurements go into the lane's memory, `observe`, `act` and `command` of
`equipoise.control.control_step` and `.policy` run, and what they leave there comes out.
"""

from collections.abc import Sequence
from math import asin, sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.compiled import kernel
from equipoise.control.boxes import box_index, boxes
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
from equipoise.model.arms.arm import (
    FRAME_SIZE,
    FREE_JOINTS,
    POSITION,
    ROTATION,
    TWIST,
    Arm,
    KinematicsFunction,
)
from equipoise.model.elementary import BATCH_SIZE, at

Array = npt.NDArray[np.float64]


class Observation(NamedTuple):
    """What the policy sees."""

    x: float
    """Displacement of the flange from home [m]."""
    x_dot: float
    """Its velocity [m/s]."""
    phi: float
    """Angle of the pendulum from upright [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""


class StateEstimate(NamedTuple):
    """What the observer believes now."""

    phi: float
    """Angle of the pendulum from upright [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""
    bias: float
    """What the encoder reads too much of phi [rad]."""
    v: float
    """Velocity of the pivot along x [m/s]."""
    x: float
    """Displacement of the flange from home [m]."""


class Controller:
    """A controller with its memory."""

    def __init__(self, arm: Arm, controller: ControllerParams) -> None:
        """Begin at home, at rest."""
        self._arm, self._controller = arm, controller
        self._memory, self._boxes = new_controller_state(), boxes()
        self._free = list(arm.free)
        self._home_x = float(controller.home_reference[POSITION])
        self.begin(0.0, 0.0)

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        return self._controller.h

    def begin(self, phi: float, phi_dot: float) -> None:
        """Begin at home, at rest, with the pendulum as it was measured [rad], [rad/s]."""
        start_controller(self._controller, self._memory, 0.0, 0.0, phi, phi_dot, 0)

    def observe(
        self, counts: float, encoder_age: float, q: Sequence[float], reply_age: float
    ) -> Observation:
        """Take the measurements of a tick, and return what the policy sees.

        Args:
            counts: Encoder counts from hanging, growing with theta.
            encoder_age: How old they are [s].
            q: Measured joints, all of them [rad].
            reply_age: How old those are [s].
        """
        memory = self._memory
        memory.counts[0] = counts
        for row, joint in enumerate(self._free):
            memory.measured[row * BATCH_SIZE] = q[joint]
        observe(self._controller, memory, encoder_age, reply_age, 1)
        return self.observation

    @property
    def observation(self) -> Observation:
        """What the policy sees."""
        return Observation(*self._memory.observation[::BATCH_SIZE].tolist())

    @property
    def estimate(self) -> StateEstimate:
        """What the observer believes."""
        return StateEstimate(*self._memory.estimate[::BATCH_SIZE].tolist())

    def decide(self, policy: Policy) -> float:
        """Return the policy's u [m/s^2] for the observation."""
        return policy.act(np.array(self.observation))

    @property
    def box(self) -> int:
        """Box of the observation."""
        return int(box_index(*self.observation, self._boxes))

    def command(self, u: float) -> tuple[tuple[float, ...], ...]:
        """Accelerate the flange by u [m/s^2] over a tick, and return its setpoints [rad]."""
        memory = self._memory
        memory.u[0] = u
        command(self._controller, memory, 1)
        free = memory.setpoints[::BATCH_SIZE].reshape(SETPOINTS_PER_TICK, FREE_JOINTS).tolist()
        return tuple(self._all(one) for one in free)

    @property
    def limit_exceeded(self) -> bool:
        """Whether the last command left a limit of a joint."""
        return bool(self._memory.limit_exceeded[0])

    @property
    def q(self) -> tuple[float, ...]:
        """Commanded joints at the end of the tick, all of them [rad]."""
        return self._all(self._memory.q[::BATCH_SIZE].tolist())

    @property
    def dq(self) -> tuple[float, ...]:
        """Their velocities [rad/s]."""
        rates = [0.0] * len(self._arm.joints)
        for joint, rate in zip(self._free, self._memory.dq[::BATCH_SIZE].tolist(), strict=True):
            rates[joint] = rate
        return tuple(rates)

    @property
    def x(self) -> float:
        """Commanded displacement of the flange at the end of the tick [m]."""
        return float(self._memory.frame[POSITION * BATCH_SIZE]) - self._home_x

    @property
    def x_dot(self) -> float:
        """Its velocity [m/s]."""
        return float(self._memory.frame[TWIST * BATCH_SIZE])

    def _all(self, free: Sequence[float]) -> tuple[float, ...]:
        joints = list(self._arm.home)
        for joint, angle in zip(self._free, free, strict=True):
            joints[joint] = angle
        return tuple(joints)


class FlangePose(NamedTuple):
    """Where the flange is, by measured joints."""

    x: float
    """Displacement from home along base x [m]."""
    drift: float
    """Distance from the line through home [m]."""
    tilt: float
    """Angle from its orientation at home [rad]."""
    manipulability: float
    """|det J| [m^3]."""


class FlangeKinematics:
    """Where the flange is, for whoever watches over it."""

    def __init__(self, arm: Arm, controller: ControllerParams) -> None:
        """Take the arm's kinematics."""
        self._kinematics = controller.kinematics
        self._home = controller.home_reference
        self._free = list(arm.free)
        self._q, self._dq = np.zeros(FREE_JOINTS * BATCH_SIZE), np.zeros(FREE_JOINTS * BATCH_SIZE)
        self._frame = np.zeros(FRAME_SIZE * BATCH_SIZE)

    def place(self, q: Sequence[float]) -> FlangePose:
        """Return where measured joints, all of them [rad], have the flange."""
        for row, joint in enumerate(self._free):
            self._q[row * BATCH_SIZE] = q[joint]
        x, drift, tilt, w = flange_pose(
            self._kinematics, self._q, self._dq, self._frame, self._home
        )
        return FlangePose(float(x), float(drift), float(tilt), float(w))


@kernel
def flange_pose(
    kinematics: KinematicsFunction, q: Array, dq: Array, frame: Array, home: Array
) -> tuple[float, float, float, float]:
    """Return the entries of `FlangePose`, for the first lane of a block of joints.

    Args:
        kinematics: Of the arm.
        q: Free joints [rad], a block of 6 rows.
        dq: Zero, a block of 6 rows.
        frame: Room for the record.
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
