"""Worlds whose arm and pendulum another program, or code from outside the package, moves.

The control tick is that of all worlds: u becomes two setpoints, half a tick apart; at the end of
the tick the controller observes. With an ideal arm the observation is the true state; otherwise it
comes from an encoder and the measured joints, through the observer and the prediction.
"""

from abc import abstractmethod
from math import floor, pi

import numpy as np

from equipoise.arrays import Array, fields, new_records
from equipoise.control.control_step import ControllerState, make_controller_params, wrapped
from equipoise.control.controller import call_alone, observe_tick, start
from equipoise.control.policy import Observation
from equipoise.simulation.interface import ClosedLoop, Simulation
from equipoise.simulation.plant import Trial, draw_noise, failure, scaled
from equipoise.user_code import user_code


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
        _, arm, settings, actuator, h = simulation.setup
        self.simulation, self.pendulum = simulation, simulation.pendulum
        self.params = make_controller_params(
            arm, settings, actuator, self.pendulum, h=h, has_sensor=actuator.kind != "ideal"
        )
        self._controllers = new_records(ControllerState)
        self.controller = fields(self._controllers, ControllerState)
        plant = settings.plant
        self._sigmas = np.repeat([plant.position_error_sigma, plant.orientation_error_sigma], 3)
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
        x, x_dot, phi, phi_dot = trial.start
        self.trial, self._tick, self.now, self.tracked = trial, 0, 0.0, 0.0
        self.pendulum = scaled(self.simulation.pendulum, trial.variation)
        self.zero = trial.variation.zero if self.params.has_sensor else None
        measured = Observation(x, x_dot, phi + (self.zero or 0.0), phi_dot)
        start(self.params, self._controllers, measured)
        with user_code(f"the world {self.simulation.world}"):
            self.release(self.controller.q[:, 0].copy(), trial.start)
            self._observe()

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        simulation, controller, before = self.simulation, self.controller, float(self._state[1])
        if not self.params.has_sensor:
            tick, number = np.array([self._tick]), np.array([self.trial.number])
            draw_noise(controller.noise, simulation.seed, tick, number, simulation.stream, 1)
            controller.noise[:, 0] *= self._sigmas
        controller.u[0] = u
        call_alone(self.params.command, self.params, self._controllers)
        with user_code(f"the world {simulation.world}"):
            for q in controller.setpoints[:, :, 0]:
                self.send(q)
            self._tick += 1
            self.now = self._tick * self.params.h
            self._observe()
        if self.params.has_sensor:
            observe_tick(self.params, self._controllers, (0.0, 0.0))
        state, exceeded = Observation(*self._state.tolist()), bool(controller.limit_exceeded[0])
        self.tracked = (state.x_dot - before) / self.params.h
        return failure(state, exceeded, simulation.max_speed, self.balancing)

    def _observe(self) -> None:
        """Read the state and the measurements; without an encoder the state is the observation."""
        self._state[:] = self.read()
        self._state[2] = wrapped(self._state[2])
        controller = self.controller
        if not self.params.has_sensor:
            seen = controller.observation
            seen.x[0], seen.x_dot[0], seen.phi[0], seen.phi_dot[0] = self._state
            return
        theta = pi - (self.angle() + (self.zero or 0.0))
        controller.counts[0] = floor(theta / self.params.resolution + 0.5)
        controller.measured[:, 0] = self.joints()[list(self.simulation.setup.arm.free)]

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return self._state.copy()
