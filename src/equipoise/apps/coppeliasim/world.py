"""Trials in CoppeliaSim, a tick at a time: its kinematic arm, or arm and pendulum in its engine.

Kinematic, as the paper's simulation in V-REP: the controller of the world `ideal` commands the
joints, CoppeliaSim places them and gives the pose of the flange at the middle and at the end of a
tick. Over a tick the acceleration is constant, so three places give the velocity at its end::

    v = (3 p(h) - 4 p(h / 2) + p(0)) / h        u' = (v - v_before) / h

and the pendulum advances by the compiled step of the training.

Dynamic: as on a twin, the controller sends two setpoints per tick, which reach the position
controllers of CoppeliaSim after the transport delay; its engine moves arm and pendulum; joints and
the pendulum's angle, as encoder counts, are measured at the end of the tick. Before the release
the pendulum is led at its initial rate for `LEAD_STEPS` steps, as by a hand.

Every call waits for its answer, and CoppeliaSim advances in `step` alone. One scene is one rig:
trials run one after the other.
"""

import threading
from collections import deque
from collections.abc import Sequence
from math import atan2, pi
from typing import Any, ClassVar, Final

import numpy as np

from equipoise import paper
from equipoise.apps.coppeliasim.address import SETPOINT_PERIOD, Address
from equipoise.apps.coppeliasim.rig import CoppeliaRig
from equipoise.apps.coppeliasim.scene import HAND_TORQUE, set_pendulum
from equipoise.control.control_step import (
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    command,
    make_controller_params,
    new_controller_state,
    observe,
    start_controller,
)
from equipoise.control.grid import (
    ANGLE,
    JOINT_LIMIT,
    PHI_LIMIT,
    SAFETY_STOP,
    TRACK,
    TRUNCATED,
)
from equipoise.control.policy import KernelPolicy, PolicyKernel
from equipoise.jit import kernel, struct_ref
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.elementary import BATCH_SIZE, at, put
from equipoise.model.encoder import counts_from_theta
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.pendulum import step as pendulum_step
from equipoise.model.worlds import TwinSettings, pivot_friction
from equipoise.safety.rules import NO_VIOLATION
from equipoise.safety.trial import (
    TrialSafetyMonitor,
    new_trial_monitor,
    reset_trial_monitor,
    setpoint_violation,
    trial_safety,
    trial_violation,
)
from equipoise.worlds.interface import (
    Array,
    ClosedLoop,
    Measurement,
    Setup,
    Simulation,
    run_trial,
)
from equipoise.worlds.plant import SPEED_LIMIT_CAUSE, draw_noise, scaled
from equipoise.worlds.trials import Trial, Trials, draw_trials
from equipoise.worlds.twin.sensors import encoder_zero

LEAD_STEPS: Final = 4
"""Number of steps for which the pendulum is led to its release."""

ControllerHandle: Any = struct_ref(
    "ControllerHandle", __name__, ("params", "state", "monitor", "q")
)


@kernel
def new_controller_handle(
    params: ControllerParams, state: ControllerState, monitor: TrialSafetyMonitor, q: Array
) -> Any:
    """Return a controller with its safety rules that kernels take by reference.

    Args:
        params: Constants.
        state: State, in the first lane.
        monitor: Safety rules.
        q: Scratch array: free joints [rad], shape (6,).
    """
    return ControllerHandle(params, state, monitor, q)


@kernel
def start_loop(loop: Any, x: float, x_dot: float, phi: float, phi_dot: float) -> None:
    """Start the controller at a place on the track; see `start_controller`."""
    start_controller(loop.params, loop.state, x, x_dot, phi, phi_dot, 0)
    reset_trial_monitor(loop.monitor, loop.params.home)


@kernel
def command_setpoints(loop: Any) -> None:
    """Compute the setpoints of a tick from u; see `command`."""
    command(loop.params, loop.state, 1)


@kernel
def check_setpoint(loop: Any, s: int, now: float) -> int:
    """Return the code of the rule that forbids setpoint `s` of the tick, `NO_VIOLATION` if none.

    Args:
        loop: The controller.
        s: Number of the setpoint in the tick.
        now: Time since the release [s].
    """
    state, monitor = loop.state, loop.monitor
    if not monitor.active:
        return NO_VIOLATION
    for i in range(FREE_JOINTS):
        loop.q[i] = at(state.setpoints, 6 * s + i, 0)
        monitor.lead[i] = at(state.leads, 6 * s + i, 0)
    return setpoint_violation(monitor, loop.q, now)


@kernel
def observe_joints(loop: Any, counts: float, q: Array, now: float) -> int:
    """Compute the observation from new measurements; return the code of a broken rule.

    Args:
        loop: The controller.
        counts: Encoder counts.
        q: Measured free joints [rad], shape (6,).
        now: Time since the release [s].
    """
    state = loop.state
    put(state.counts, 0, 0, counts)
    for i in range(FREE_JOINTS):
        put(state.measured, i, 0, q[i])
    observe(loop.params, state, 0.0, 0.0, 1)
    if not loop.monitor.active:
        return NO_VIOLATION
    return trial_violation(loop.monitor, loop.params, state, q, now)


class CoppeliaSimulation(Simulation):
    """Trials in a CoppeliaSim."""

    PIECE: ClassVar[int] = 1
    MOST_LOOPS: ClassVar[int] = 1

    def __init__(self, address: Address, setup: Setup, *, seed: int, stream: int) -> None:
        """Connect, and build the scene.

        Args:
            address: Machine, engine and numbers.
            setup: Pendulum, arm and controller; of several actuators the first one holds.
            seed: Master seed.
            stream: Purpose of the trials.

        Raises:
            ArmError: Home is a singular posture, or an engine lacks the masses of the arm's links.
            LinkError: No CoppeliaSim answers.
            MissingExtraError: The client is not installed.
            OutsideError: CoppeliaSim runs a simulation already, or reports an error.
            SettingsError: The delay exceeds the controller's history.
        """
        pendulum, arm, settings, _, h = self.setup = setup
        self.seed, self.stream, self.numbers = seed, stream, address.numbers
        self.nominal = pendulum.parameters(linearised=settings.plant.linearised)
        counts = settings.plant.counts_per_rev
        if self.numbers is not None:
            counts = self.numbers.counts_per_rev
        self.params = make_controller_params(
            arm,
            settings,
            setup.actuator,
            self.nominal,
            h=h,
            counts_per_rev=counts,
            has_sensor=self.numbers is not None,
        )
        self._lock = threading.Lock()
        self.rig = CoppeliaRig(address, setup, self.nominal)

    def draw(self, count: int, first: int = 0) -> Trials:
        """Draw the conditions of `count` trials from number `first` on."""
        settings, numbers = self.setup.settings, self.numbers
        if numbers is not None:
            plant = settings.plant.model_copy(
                update={
                    "inertia_sigma": numbers.inertia_sigma,
                    "friction_sigma": numbers.friction_sigma,
                }
            )
            settings = settings.model_copy(update={"plant": plant})
        return draw_trials(count, settings, self.seed, self.stream, 1.0, first)

    def loop(self) -> "KinematicLoop | DynamicLoop":
        """Return a closed loop for `reset`; all of them share the one scene."""
        return KinematicLoop(self) if self.numbers is None else DynamicLoop(self, self.numbers)

    def run_piece(
        self, policy: PolicyKernel, trials: Trials, rows: Sequence[int], duration: float
    ) -> None:
        """Run trials of a compiled policy, one at a time in all threads; see `Simulation.run`."""
        with self._lock:
            loop: ClosedLoop = self.loop()
            for row in rows:
                ended = run_trial(loop, KernelPolicy(policy), trials.trial(row), duration)
                trials.steps[row], trials.cause[row], trials.sum_x2[row] = ended

    def varied(self, trial: Trial) -> PendulumParameters:
        """Return the pendulum of a trial, with the friction that acts."""
        own = trial.variation
        pendulum = scaled(self.nominal, own.inertia_factor, own.friction_factor)
        if self.numbers is None:
            return pendulum
        return pivot_friction(self.setup.pendulum, self.numbers).on(pendulum)


class KinematicLoop:
    """Closed loop on the kinematic arm, with the pendulum of Equipoise."""

    zero: float | None = None
    chosen = 0

    def __init__(self, simulation: CoppeliaSimulation) -> None:
        """Allocate the controller."""
        self._simulation, self._rig = simulation, simulation.rig
        self.params, self.controller = simulation.params, new_controller_state()
        arm, q = simulation.setup.arm, np.zeros(FREE_JOINTS)
        monitor = new_trial_monitor(arm, None)
        self._handle = new_controller_handle(self.params, self.controller, monitor, q)
        self._home_x = float(self.params.home_reference[0])
        self._pivot, self._state = np.array(arm.pivot), np.zeros(4)
        self.pendulum, self.now, self.tracked, self._tick = simulation.nominal, 0.0, 0.0, 0
        plant = simulation.setup.settings.plant
        self._sigmas = np.repeat([plant.position_error_sigma, plant.orientation_error_sigma], 3)
        limit = plant.max_speed
        self._fastest = np.inf if limit is None else limit

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        rig, self._trial, self._tick, self.now, self.tracked = self._rig, trial, 0, 0.0, 0.0
        x, x_dot, phi, phi_dot = trial.start
        self.pendulum = self._simulation.varied(trial)
        start_loop(self._handle, x, x_dot, phi, phi_dot)
        rig.stop()
        rig.place(self.controller.q[::BATCH_SIZE])
        rig.sim.call("setJointPosition", rig.scene.spindle, phi)
        rig.start()
        self._flange, self._pivot_x = self._places()
        self._velocity = x_dot
        self._set_state(self._flange - self._home_x, x_dot, phi, phi_dot)

    def _places(self) -> tuple[float, float]:
        """Return the places of flange and pivot along base x [m]."""
        position, R = self._rig.pose(self._rig.scene.flange)
        return float(position[0]), float(position[0] + R[0] @ self._pivot)

    def _set_state(self, x: float, x_dot: float, phi: float, phi_dot: float) -> None:
        self._state[:] = x, x_dot, phi, phi_dot
        self.controller.observation[::BATCH_SIZE] = self._state

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure.

        Raises:
            OutsideError: Another program stopped or changed the simulation.
        """
        if (cause := self._advance(u)) != TRUNCATED:
            self._rig.check()
        return cause

    def _advance(self, u: float) -> int:
        rig, controller, h = self._rig, self.controller, self.params.h
        seed, stream = self._simulation.seed, self._simulation.stream
        tick, number = np.array([self._tick]), np.array([self._trial.number])
        draw_noise(controller.noise, seed, tick, number, 0, stream, 1)
        controller.noise[::BATCH_SIZE] *= self._sigmas
        controller.u[0] = u
        command_setpoints(self._handle)
        places = [(self._flange, self._pivot_x)]
        for s in range(SETPOINTS_PER_TICK):
            rig.place(
                controller.setpoints[6 * s * BATCH_SIZE : 6 * (s + 1) * BATCH_SIZE : BATCH_SIZE]
            )
            places.append(self._places())
        (x0, p0), (x1, p1), (self._flange, self._pivot_x) = places
        x_dot = (3.0 * self._flange - 4.0 * x1 + x0) / h
        v = (3.0 * self._pivot_x - 4.0 * p1 + p0) / h
        self.tracked, self._velocity = (v - self._velocity) / h, v
        phi, phi_dot = float(self._state[2]), float(self._state[3])
        phi, phi_dot = pendulum_step(phi, phi_dot, self.tracked, h, self.pendulum)
        rig.sim.call("setJointPosition", rig.scene.spindle, phi)
        rig.step()
        self._tick += 1
        self.now = self._tick * h
        x = self._flange - self._home_x
        self._set_state(x, x_dot, phi, phi_dot)
        if not abs(phi) < PHI_LIMIT:
            return ANGLE
        if not abs(x) < paper.X_LIMIT:
            return TRACK
        if controller.limit_exceeded[0]:
            return JOINT_LIMIT
        return TRUNCATED if abs(x_dot) < self._fastest else SPEED_LIMIT_CAUSE

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return self._state.copy()

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        return self._rig.joints()

    def measurement(self) -> Measurement | None:
        """Return None: the state is measured exactly."""
        return None


class DynamicLoop:
    """Closed loop on arm and pendulum in a physics engine of CoppeliaSim."""

    chosen = 0

    def __init__(self, simulation: CoppeliaSimulation, numbers: TwinSettings) -> None:
        """Allocate the controller."""
        self._simulation, self._rig, self._numbers = simulation, simulation.rig, numbers
        self.params, self.controller = simulation.params, new_controller_state()
        _, arm, settings, _, h = simulation.setup
        speed = settings.plant.max_speed
        rules = trial_safety(arm, numbers, simulation.setup.actuator, h, speed)
        monitor, q = new_trial_monitor(arm, rules), np.zeros(FREE_JOINTS)
        self._handle = new_controller_handle(self.params, self.controller, monitor, q)
        self._home_x, self._free = float(self.params.home_reference[0]), np.array(arm.free)
        self._delay = round(numbers.transport / SETPOINT_PERIOD)
        self.pendulum, self.now, self.tracked, self._tick = simulation.nominal, 0.0, 0.0, 0
        self.zero: float | None = None

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial, the arm at rest at home."""
        rig, sim, scene, numbers = self._rig, self._rig.sim, self._rig.scene, self._numbers
        _, _, phi, phi_dot = trial.start
        self.pendulum = self._simulation.varied(trial)
        self.zero = encoder_zero(numbers, self._simulation.seed, trial.number)
        rig.stop()
        set_pendulum(sim, scene, rig.address, self.pendulum)
        rig.place(self.params.home)
        rig.aim(self.params.home)
        sim.call("setJointPosition", scene.spindle, phi - LEAD_STEPS * SETPOINT_PERIOD * phi_dot)
        sim.call("setJointTargetVelocity", scene.spindle, phi_dot)
        # A signed torque would turn a negative velocity.
        sim.call("setJointTargetForce", scene.spindle, HAND_TORQUE, False)
        rig.start()
        for _ in range(LEAD_STEPS):
            rig.step()
        sim.call("setJointTargetForce", scene.spindle, 0.0, False)
        self._sent = deque([self.params.home] * self._delay)
        self._tick, self.now, self.tracked = 0, 0.0, 0.0
        self._read()
        shown = pi - self._counts * self.params.resolution
        start_loop(self._handle, 0.0, 0.0, shown, phi_dot)

    def _read(self) -> None:
        """Read the true state and the measurements."""
        rig, scene = self._rig, self._rig.scene
        position, _ = rig.pose(scene.flange)
        x_dot = rig.velocity(scene.flange)[0][0]
        dx, _, dz = d = rig.pose(scene.rod)[1][:, 2]
        change = np.cross(rig.velocity(scene.rod)[1], d)
        phi_dot = (change[0] * dz - change[2] * dx) / (dx * dx + dz * dz)
        self._state = np.array([position[0] - self._home_x, x_dot, atan2(dx, dz), phi_dot])
        self._q = rig.joints()
        phi = rig.sim.call("getJointPosition", scene.spindle)
        theta = pi - (phi + (self.zero or 0.0))
        self._counts = float(counts_from_theta(theta, float(self._numbers.counts_per_rev), 1.0))

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure.

        Raises:
            OutsideError: Another program stopped or changed the simulation.
        """
        if (cause := self._advance(u)) != TRUNCATED:
            self._rig.check()
        return cause

    def _advance(self, u: float) -> int:
        rig, controller, before = self._rig, self.controller, self._state
        controller.u[0] = u
        command_setpoints(self._handle)
        for s in range(SETPOINTS_PER_TICK):
            broken = check_setpoint(self._handle, s, self.now + s * SETPOINT_PERIOD)
            if broken != NO_VIOLATION:
                return SAFETY_STOP + broken
            rows = slice(6 * s * BATCH_SIZE, 6 * (s + 1) * BATCH_SIZE, BATCH_SIZE)
            self._sent.append(controller.setpoints[rows].copy())
            rig.aim(self._sent.popleft())
            rig.step()
        self._read()
        self._tick += 1
        self.now = self._tick * self.params.h
        self.tracked = float(self._state[1] - before[1]) / self.params.h
        broken = observe_joints(self._handle, self._counts, self._q[self._free], self.now)
        # Written so that NaN is a failure.
        if not abs(self._state[2]) < PHI_LIMIT:
            return ANGLE
        if not abs(self._state[0]) < paper.X_LIMIT:
            return TRACK
        if controller.limit_exceeded[0]:
            return JOINT_LIMIT
        return TRUNCATED if broken == NO_VIOLATION else SAFETY_STOP + int(broken)

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return self._state.copy()

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        return self._q.copy()

    def measurement(self) -> Measurement:
        """Return the measurements of this tick."""
        return Measurement(self._counts, self.now, self._q[self._free], self.now)
