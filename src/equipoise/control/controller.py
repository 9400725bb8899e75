"""Controller of one arm for Python: the kernels of the training, on one lane.

`Controller` writes measurements into the lane's state, calls `observe` and `command` of
`equipoise.control.control_step`, and reads their results from there.
"""

from collections.abc import Callable, Sequence
from math import asin, ceil, sqrt
from typing import Any, NamedTuple

import numpy as np

from equipoise.arrays import Array
from equipoise.control.clik import manipulability
from equipoise.control.control_step import (
    HISTORY_TICKS,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    advance_arm_model,
    command,
    new_controller_state,
    observe,
    start_controller,
)
from equipoise.control.grid import box_indices, make_grid
from equipoise.control.policy import Policy
from equipoise.jit import kernel, struct_ref
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.arms.compiler import FRAME_SIZE, POSITION, ROTATION, TWIST, KinematicsFunction
from equipoise.model.elementary import BATCH_SIZE, at
from equipoise.settings import BoxSettings


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


ControllerHandle: Any = struct_ref("ControllerHandle", __name__, ("params", "state"))


@kernel
def new_controller_handle(params: ControllerParams, state: ControllerState) -> Any:
    """Return a controller that kernels take by reference."""
    return ControllerHandle(params, state)


@kernel
def observe_tick(controller: Any, encoder_age: float, reply_age: float) -> None:
    """Compute the observation; see `control_step.observe`."""
    observe(controller.params, controller.state, encoder_age, reply_age, 1)


@kernel
def command_tick(controller: Any) -> None:
    """Compute the setpoints from u; see `control_step.command`."""
    command(controller.params, controller.state, 1)


@kernel
def hold_tick(controller: Any) -> None:
    """Advance the model of the arm towards the last setpoints."""
    advance_arm_model(controller.params, controller.state, 1)


class Controller:
    """A controller with its state."""

    def __init__(self, arm: Arm, controller: ControllerParams, boxes: BoxSettings) -> None:
        """Begin at home, at rest."""
        self._arm, self._controller = arm, controller
        self._state, self._boxes = new_controller_state(), make_grid(boxes, controller.pendulum.k)
        # By whether there are counts and measured joints: without, the model is not corrected.
        self._handles = {
            (counts, joints): new_controller_handle(
                controller._replace(
                    gains=controller.gains if counts else (0.0, 0.0, 0.0),
                    correction=controller.correction if joints else 0.0,
                ),
                self._state,
            )
            for counts in (False, True)
            for joints in (False, True)
        }
        self._handle = self._handles[True, True]
        self._free = list(arm.free)
        self._home_x = float(controller.home_reference[POSITION])
        # A tick in the past needs the motion from its delay, and the age of its sample, before it.
        self._kept = HISTORY_TICKS - 2 - ceil(controller.delay / controller.h + 1.0)
        self.begin(0.0, 0.0)

    def begin(self, phi: float, phi_dot: float) -> None:
        """Begin at home, at rest, with the measured pendulum [rad], [rad/s]."""
        start_controller(self._controller, self._state, 0.0, 0.0, phi, phi_dot, 0)
        state = self._state
        self._model = state.model_q.copy(), state.model_dq.copy()
        # Estimate at the last tick with counts, and the number of ticks since.
        self._confirmed, self._blind = state.estimate.copy(), 0

    def observe(
        self,
        counts: float | None,
        encoder_age: float,
        q: Sequence[float] | None,
        reply_age: float,
        before: Callable[[float], tuple[float, float] | None] = lambda _: None,
    ) -> None:
        """Compute the observation from the measurements of a tick.

        Without a count the observer predicts. Counts that come later are taken in order: the
        observer goes back to the last tick with a count, and observes each tick since again.

        Args:
            counts: Encoder counts from hanging, growing with theta; None without new ones.
            encoder_age: Age of the counts [s].
            q: Measured joints, all of them [rad]; None without a new measurement.
            reply_age: Age of the joints [s].
            before: Returns the counts of a tick by its time before this one [s], and their age [s];
                None without counts. Called for the ticks since the last one with counts.
        """
        state, newest = self._state, int(self._state.newest[0])
        if q is not None:
            state.measured[::BATCH_SIZE] = [q[joint] for joint in self._free]
        if 0 < self._blind <= self._kept:
            state.estimate[:] = self._confirmed
        else:
            self._blind = 0
        self._blind += 1
        for back in range(self._blind - 1, 0, -1):
            state.newest[0] = (newest - back) % HISTORY_TICKS
            self._observe(back, before(back * self._controller.h))
        state.newest[0] = newest
        sample = None if counts is None else (counts, encoder_age)
        self._observe(0, sample, None if q is None else reply_age)

    def _observe(
        self, back: int, sample: tuple[float, float] | None, reply_age: float | None = None
    ) -> None:
        """Observe the newest tick of the history with the measurements that there are.

        Args:
            back: Number of ticks since.
            sample: Counts and their age [s].
            reply_age: Age of the measured joints [s].
        """
        state, age = self._state, 0.0
        if sample is not None:
            state.counts[0], age = sample
        handle = self._handles[sample is not None, reply_age is not None]
        observe_tick(handle, age, 0.0 if reply_age is None else reply_age)
        if sample is not None:
            self._confirmed[:], self._blind = state.estimate, back

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
        state.setpoints[::BATCH_SIZE] = held * SETPOINTS_PER_TICK
        if unsent:  # the model has followed it over half a tick
            state.model_q[:], state.model_dq[:] = self._model
            state.newest[0] = (state.newest[0] - 1) % HISTORY_TICKS
            self.hold()
        for _ in range(missed):
            self._observe(0, None)
            self._blind += 1
            self.hold()
        state.q[::BATCH_SIZE], state.dq[:], state.ddq[:] = held, 0.0, 0.0
        self._controller.kinematics(state.q, state.dq, state.frame, 1)
        state.reference[POSITION * BATCH_SIZE] = state.frame[POSITION * BATCH_SIZE]
        state.reference[TWIST * BATCH_SIZE] = 0.0

    def hold(self) -> None:
        """Advance the model of the arm by a tick, towards the last setpoints."""
        hold_tick(self._handle)

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
        return int(box_indices(np.array([self.observation]), self._boxes)[0])

    def command(self, u: float) -> tuple[tuple[float, ...], ...]:
        """Accelerate the flange by u [m/s^2] over a tick, and return its setpoints [rad]."""
        state = self._state
        self._model[0][:], self._model[1][:] = state.model_q, state.model_dq
        state.u[0] = u
        command_tick(self._handle)
        setpoints = state.setpoints.reshape(SETPOINTS_PER_TICK, -1)
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
        self._free, self._q = list(arm.free), np.zeros(FREE_JOINTS * BATCH_SIZE)
        dq, frame = np.zeros(FREE_JOINTS * BATCH_SIZE), np.zeros(FRAME_SIZE * BATCH_SIZE)
        self._parts = controller.kinematics, self._q, dq, frame, controller.home_reference

    def pose(self, q: Sequence[float]) -> FlangePose:
        """Return the pose of the flange at measured joints, all of them [rad]."""
        self._q[::BATCH_SIZE] = [q[joint] for joint in self._free]
        return FlangePose(*map(float, flange_pose(*self._parts)))


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
