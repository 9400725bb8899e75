"""Controller of one arm for Python: the kernels of the training, on one lane.

`Controller` writes measurements into the lane's state, calls `observe` and `command` of
`equipoise.control.control_step`, and reads their results from there.
"""

from collections.abc import Callable, Sequence
from math import asin, ceil, sqrt
from typing import NamedTuple

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arm.clik import manipulability
from equipoise.arm.compiler import FRAME_SIZE, POSITION, ROTATION, TWIST
from equipoise.arrays import Array, Records, fields, first_lane, new_records
from equipoise.control.control_step import (
    HISTORY_TICKS,
    ControllerParams,
    ControllerState,
    kinematics,
)
from equipoise.control.policy import Observation, Policy
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import call, compilable, kernel
from equipoise.model.actuator import ROWS
from equipoise.model.grid import box_index, make_grid
from equipoise.settings import BoxSettings

Counted = tuple[float, float]
"""Encoder counts from hanging, growing with theta, and their age [s]."""


class StateEstimate(NamedTuple):
    """Estimate of the observer at the tick."""

    phi: float
    """Angle of the pendulum from upright [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""
    bias: float
    """Encoder zero offset [rad]."""
    pivot_v: float
    """Velocity of the pivot along x [m/s]."""
    x: float
    """Displacement of the flange from home [m]."""


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


@kernel
def observe_tick(params: ControllerParams, states: Records, ages: tuple[float, float]) -> None:
    """Compute the observation; see `control_step.observe`."""
    call(params.observe, (params, states[0], ages, 1))


@kernel
def call_alone(function: int, params: ControllerParams, states: Records) -> None:
    """Call `command` or `advance_arm_model` in the first lane, by its address in `params`."""
    call(function, (params, states[0], 1))


@kernel
def start(params: ControllerParams, states: Records, measured: Observation) -> None:
    """Start the first lane; see `control_step.start_controller`."""
    call(params.start_controller, (params, states[0], measured, 0))


class Controller:
    """A controller with its state."""

    def __init__(self, arm: Arm, controller: ControllerParams, boxes: BoxSettings) -> None:
        """Begin at home, at rest."""
        self._arm, self._params = arm, controller
        self._states = new_records(ControllerState)
        self._state = fields(self._states, ControllerState)
        self._boxes = make_grid(boxes, controller.pendulum.k)
        self._posture, self._still = np.zeros((2, *ROWS))
        self._frame = np.zeros((FRAME_SIZE, BATCH_SIZE))
        # Without counts or measured joints nothing is corrected.
        self._blind_params = controller._replace(gains=(0.0, 0.0, 0.0))
        self._free = list(arm.free)
        self._home_x = float(controller.home_reference[POSITION])
        # A tick in the past needs the motion from its delay, and the age of its sample, before it.
        self._kept = HISTORY_TICKS - 2 - ceil(controller.delay / controller.h + 1.0)
        self.begin(0.0, 0.0)

    def begin(self, phi: float, phi_dot: float) -> None:
        """Begin at home, at rest, with the measured pendulum [rad], [rad/s]."""
        start(self._params, self._states, Observation(0.0, 0.0, phi, phi_dot))
        state = self._state
        self._model = state.model.q.copy(), state.model.dq.copy()
        # Estimate at the last tick with counts, and the number of ticks since.
        self._confirmed, self._blind = self._states["estimate"].copy(), 0

    def observe(
        self,
        sample: Counted | None,
        reply: tuple[Sequence[float], float] | None,
        before: Callable[[float], Counted | None] = lambda _: None,
    ) -> None:
        """Compute the observation from the measurements of a tick.

        Without a count the observer predicts. Counts that come later are taken in order: the
        observer goes back to the last tick with a count, and observes each tick since again.

        Args:
            sample: Encoder counts and their age; None without new ones.
            reply: Measured joints, all of them [rad], and their age [s]; None without new ones.
            before: Returns the sample of a tick by its time before this one [s]; None without one.
                Called for the ticks since the last one with counts.
        """
        state, newest = self._state, int(self._state.newest[0])
        if reply is not None:
            state.measured[:, 0] = [reply[0][joint] for joint in self._free]
        if 0 < self._blind <= self._kept:
            self._states["estimate"] = self._confirmed
        else:
            self._blind = 0
        self._blind += 1
        for back in range(self._blind - 1, 0, -1):
            state.newest[:] = (newest - back) % HISTORY_TICKS
            self._observe(back, before(back * self._params.h))
        state.newest[:] = newest
        self._observe(0, sample, None if reply is None else reply[1])

    def _observe(self, back: int, sample: Counted | None, reply_age: float | None = None) -> None:
        """Observe the newest tick of the history with the measurements that there are.

        Args:
            back: Number of ticks since.
            sample: Encoder counts and their age.
            reply_age: Age of the measured joints [s].
        """
        params = self._blind_params if sample is None else self._params
        counts, age = sample or (0.0, 0.0)
        if reply_age is None:
            params = params._replace(correction=0.0)
        self._state.counts[0] = counts
        observe_tick(params, self._states, (age, reply_age or 0.0))
        if sample is not None:
            self._confirmed[:], self._blind = self._states["estimate"], back

    def rest(self, q: Sequence[float], missed: int, unsent: bool) -> None:
        """Begin anew from an arm that comes to rest at the last setpoint sent.

        The model of the arm follows that setpoint over the missed ticks, without a measurement; the
        next `observe` adds those that have come since.

        Args:
            q: The last setpoint sent, all joints [rad].
            missed: Number of missed ticks.
            unsent: Whether the second setpoint of the last command was not sent.
        """
        state = self._state
        held = [q[joint] for joint in self._free]
        state.setpoints[:, :, 0] = held
        if unsent:  # the model has followed it over half a tick
            state.model.q[:], state.model.dq[:] = self._model
            state.newest[:] = (state.newest[0] - 1) % HISTORY_TICKS
            self.hold()
        for _ in range(missed):
            self._observe(0, None)
            self._blind += 1
            self.hold()
        state.q[:, 0], state.dq[:], state.ddq[:] = held, 0.0, 0.0
        kinematics(self._params.kinematics, state.q, state.dq, state.frame, 1)
        state.reference[POSITION, 0] = state.frame[POSITION, 0]
        state.reference[TWIST, 0] = 0.0

    def hold(self) -> None:
        """Advance the model of the arm by a tick, towards the last setpoints."""
        call_alone(self._params.advance_arm_model, self._params, self._states)

    @property
    def observation(self) -> Observation:
        """Observation of the policy."""
        return Observation(*first_lane(self._state.observation).tolist())

    @property
    def estimate(self) -> StateEstimate:
        """Estimate of the observer."""
        return StateEstimate(*first_lane(self._state.estimate).tolist())

    @property
    def balancing(self) -> bool:
        """Whether the encoder's zero is estimated: a balanced pendulum is upright on average."""
        return bool(self._state.balancing[0])

    @balancing.setter
    def balancing(self, value: bool) -> None:
        self._state.balancing[0] = value

    def decide(self, policy: Policy) -> float:
        """Return the policy's u [m/s^2] for the observation."""
        return policy.act(first_lane(self._state.observation))

    @property
    def box(self) -> int:
        """Box of the observation."""
        return box_index(*self.observation, self._boxes)

    def command(self, u: float) -> tuple[tuple[float, ...], ...]:
        """Accelerate the flange by u [m/s^2] over a tick.

        Returns:
            The setpoints of the tick, all joints [rad]: half a tick later, and at its end.
        """
        state = self._state
        self._model[0][:], self._model[1][:] = state.model.q, state.model.dq
        state.u[0] = u
        call_alone(self._params.command, self._params, self._states)
        return tuple(self._all_joints(self._arm.home, free) for free in state.setpoints)

    @property
    def limit_exceeded(self) -> bool:
        """Whether the last command exceeded a limit of a joint."""
        return bool(self._state.limit_exceeded[0])

    @property
    def dq(self) -> tuple[float, ...]:
        """Commanded velocities of all joints at the end of the tick [rad/s]."""
        return self._all_joints((0.0,) * len(self._arm.joints), self._state.dq)

    @property
    def x(self) -> float:
        """Commanded displacement of the flange at the end of the tick [m]."""
        return float(self._state.frame[POSITION, 0]) - self._home_x

    @property
    def x_dot(self) -> float:
        """Its velocity [m/s]."""
        return float(self._state.frame[TWIST, 0])

    def pose(self, q: Sequence[float]) -> FlangePose:
        """Return the pose of the flange at measured joints, all of them [rad]."""
        self._posture[:, 0] = [q[joint] for joint in self._free]
        return _measured_pose(self._params, self._posture, self._still, self._frame)

    def _all_joints(self, held: Sequence[float], free: Array) -> tuple[float, ...]:
        """Return `held` with the free joints of the first lane."""
        joints = np.array(held, np.float64)
        joints[self._free] = free[:, 0]
        return tuple(joints.tolist())


@kernel
def _measured_pose(params: ControllerParams, q: Array, dq: Array, frame: Array) -> FlangePose:
    kinematics(params.kinematics, q, dq, frame, 1)
    return flange_pose(frame, params.home_reference)


@compilable
def flange_pose(frame: Array, home: Sequence[float]) -> FlangePose:
    """Return the pose of the flange in the first lane.

    Args:
        frame: Record of the kinematics at the measured joints.
        home: Pose of the flange at home, `ControllerParams.home_reference`.
    """
    x = frame[POSITION, 0] - home[POSITION]
    y = frame[POSITION + 1, 0] - home[POSITION + 1]
    z = frame[POSITION + 2, 0] - home[POSITION + 2]
    trace = 0.0
    for i in range(9):
        trace += frame[ROTATION + i, 0] * home[ROTATION + i]
    # 1 - cos of the angle, from the trace of the rotation between them.
    away = min(max(0.5 * (3.0 - trace), 0.0), 2.0)
    drift, tilt = sqrt(y * y + z * z), 2.0 * asin(sqrt(0.5 * away))
    return FlangePose(x, drift, tilt, abs(manipulability(frame, 0)))
