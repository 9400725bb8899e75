"""Worlds whose arm and pendulum another program, or code from outside the package, moves.

The control tick is that of all worlds: u becomes two setpoints, half a tick apart; at the end of
the tick the controller observes. With an ideal arm the observation is the true state; otherwise it
comes from an encoder and the measured joints, through the observer and the prediction.
"""

from abc import abstractmethod
from math import floor, inf, pi

import numpy as np

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.control_step import (
    SETPOINTS_PER_TICK,
    make_controller_params,
    new_controller_state,
    start_controller,
)
from equipoise.control.controller import command_tick, new_controller_handle, observe_tick
from equipoise.control.grid import (
    ANGLE,
    JOINT_LIMIT,
    PHI_LIMIT,
    TRACK,
    TRUNCATED,
)
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.elementary import BATCH_SIZE
from equipoise.user_code import guest_code
from equipoise.worlds.interface import ClosedLoop, Simulation
from equipoise.worlds.plant import SPEED_LIMIT_CAUSE, draw_noise, scaled
from equipoise.worlds.trials import Trial


class ExternalLoop(ClosedLoop):
    """Closed loop around an arm and a pendulum that four methods of a subclass move and read."""

    trial: Trial
    """Conditions of the trial."""

    def __init__(self, simulation: Simulation) -> None:
        """Allocate the controller.

        Raises:
            ArmError: Home is a singular posture.
            SettingsError: The delay exceeds the controller's history.
        """
        setup, nominal = simulation.setup, simulation.pendulum
        plant = setup.settings.plant
        self.simulation, self.pendulum = simulation, nominal
        self.params = make_controller_params(
            setup.arm,
            setup.settings,
            setup.actuator,
            nominal,
            h=setup.h,
            counts_per_rev=plant.counts_per_rev,
            has_sensor=setup.actuator.kind != "ideal",
        )
        self.controller = new_controller_state()
        self._handle = new_controller_handle(self.params, self.controller)
        self._sigmas = np.repeat([plant.position_error_sigma, plant.orientation_error_sigma], 3)
        self._fastest = inf if plant.max_speed is None else plant.max_speed
        self._state, self._tick = np.zeros(4), 0

    @abstractmethod
    def release(self, q: Array, start: tuple[float, float, float, float]) -> None:
        """Place the arm, and release the pendulum `self.pendulum`.

        Args:
            q: Free joints at the release [rad], shape (6,).
            start: x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release.
        """

    @abstractmethod
    def send(self, q: Array) -> None:
        """Send a setpoint of the free joints [rad], shape (6,), and advance by half a tick."""

    @abstractmethod
    def read(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""

    def angle(self) -> float:
        """Return the angle of the pendulum from upright, relative to the flange [rad].

        An encoder measures it; by default phi, as on a level flange.
        """
        return float(self._state[2])

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        own, (x, x_dot, phi, phi_dot) = trial.variation, trial.start
        self.trial, self._tick, self.now, self.tracked = trial, 0, 0.0, 0.0
        nominal = self.simulation.pendulum
        self.pendulum = scaled(nominal, own.inertia_factor, own.friction_factor)
        self.zero = own.zero if self.params.has_sensor else None
        shown = phi + (self.zero or 0.0)
        start_controller(self.params, self.controller, x, x_dot, shown, phi_dot, 0)
        with guest_code(f"the world {self.simulation.world}"):
            self.release(self.controller.q[::BATCH_SIZE].copy(), trial.start)
            self._observe()

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        simulation, controller, before = self.simulation, self.controller, float(self._state[1])
        if not self.params.has_sensor:
            tick, number = np.array([self._tick]), np.array([self.trial.number])
            draw_noise(controller.noise, simulation.seed, tick, number, 0, simulation.stream, 1)
            controller.noise[::BATCH_SIZE] *= self._sigmas
        controller.u[0] = u
        command_tick(self._handle)
        with guest_code(f"the world {simulation.world}"):
            for q in controller.setpoints[::BATCH_SIZE].reshape(SETPOINTS_PER_TICK, FREE_JOINTS):
                self.send(q)
            self._tick += 1
            self.now = self._tick * self.params.h
            self._observe()
        if self.params.has_sensor:
            observe_tick(self._handle, 0.0, 0.0)
        x, x_dot, phi, _ = self._state.tolist()
        self.tracked = (x_dot - before) / self.params.h
        # Written so that NaN is a failure.
        if not abs(phi) < PHI_LIMIT:
            return ANGLE
        if not abs(x) < paper.X_LIMIT:
            return TRACK
        if controller.limit_exceeded[0]:
            return JOINT_LIMIT
        return TRUNCATED if abs(x_dot) < self._fastest else SPEED_LIMIT_CAUSE

    def _observe(self) -> None:
        """Read the state and the measurements; without an encoder the state is the observation."""
        self._state[:] = self.read()
        controller = self.controller
        if not self.params.has_sensor:
            controller.observation[::BATCH_SIZE] = self._state
            return
        theta = pi - (self.angle() + (self.zero or 0.0))
        controller.counts[0] = floor(theta / self.params.resolution + 0.5)
        controller.measured[::BATCH_SIZE] = self.joints()[list(self.simulation.setup.arm.free)]

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return self._state.copy()
