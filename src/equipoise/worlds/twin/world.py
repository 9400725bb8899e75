"""Trials on the digital twin: worlds `twin:NAME` and `twin:FILE`."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from equipoise.control.actuator_choice import MotionRecord, choose_actuator, move_setpoints
from equipoise.control.control_step import (
    SETPOINTS_PER_TICK,
    make_controller_params,
    new_controller_state,
)
from equipoise.control.policy import PolicyKernel
from equipoise.jit import kernel, struct_ref
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings, pivot_friction
from equipoise.safety.trial import TrialSafetyMonitor, new_trial_monitor, trial_safety
from equipoise.worlds.interface import Array, Measurement, Setup, Simulation
from equipoise.worlds.plant import scaled
from equipoise.worlds.trials import Trial, Trials, draw_trials
from equipoise.worlds.twin.servo_model import make_servo_params
from equipoise.worlds.twin.trial import TrialResult, TwinTrial, release, run_trial, step
from equipoise.worlds.twin.twin import Twin, truth

TwinHandle: Any = struct_ref("TwinHandle", __name__, ("trial",))


@kernel
def new_twin_handle(trial: TwinTrial) -> Any:
    """Return a closed loop on a twin that kernels take by reference; see `trial.step`."""
    return TwinHandle(trial)


@kernel
def release_twin(loop: Any, phi: float, phi_dot: float) -> None:
    """Release the pendulum; see `trial.release`."""
    release(loop.trial, phi, phi_dot)


@kernel
def run_twin(
    loop: Any, policy: PolicyKernel, phi: float, phi_dot: float, max_steps: int
) -> TrialResult:
    """Run one trial; see `trial.run_trial`."""
    return run_trial(loop.trial, policy, phi, phi_dot, max_steps)


@kernel
def advance_twin(loop: Any, true_state: Array) -> int:
    """Advance a closed loop by one tick, and return the cause of the failure.

    Args:
        loop: The closed loop.
        true_state: Receives x, x_dot, phi, phi_dot in SI units, shape (4,).
    """
    trial = loop.trial
    cause = step(trial)
    state = truth(trial.twin)
    for i in range(4):
        true_state[i] = state[i]
    return cause


class TwinSimulation(Simulation):
    """Trials on a digital twin."""

    PIECE: ClassVar[int] = 1

    def __init__(self, world: TwinSettings, setup: Setup, *, seed: int, stream: int) -> None:
        """Set up a simulation.

        Args:
            world: Parameters of the twin.
            setup: Pendulum, arm and controller.
            seed: Master seed.
            stream: Purpose of the trials.

        Raises:
            ArmError: The masses of the arm's links are unknown, or home is a singular posture.
            SettingsError: The delay exceeds the controller's history.
        """
        pendulum, arm, settings, actuators, h = setup
        self._nominal = pendulum.parameters(linearised=settings.plant.linearised)
        self._friction = pivot_friction(pendulum, world)
        self._arm, self._world, self._settings = arm, world, settings
        self.setup, self.seed, self.stream = setup, seed, stream
        self._servo = make_servo_params(arm, world)
        given: Any = {"h": h, "counts_per_rev": world.counts_per_rev}
        self.actuators = actuators
        self.params = tuple(
            make_controller_params(arm, settings, actuator, self._nominal, **given)
            for actuator in actuators
        )
        """Constants of the controller with each actuator."""
        self._safety = [
            trial_safety(arm, world, actuator, h, settings.plant.max_speed)
            for actuator in actuators
        ]
        self.move = move_setpoints(arm, self.params[0]) if len(actuators) > 1 else None
        """Setpoints of the move before a release [rad], shape (m, 6); None without a selection."""
        self._idle: list[TwinLoop] = []

    def __reduce__(self) -> Any:
        """Return what sets the simulation up in another process."""
        given = {"seed": self.seed, "stream": self.stream}
        return partial(TwinSimulation, self._world, self.setup, **given), ()

    def draw(self, count: int, first: int = 0) -> Trials:
        """Draw the conditions of `count` trials from number `first` on.

        I and b vary by the parameters of the twin; the twin draws jitter, noise and the zero error
        of the encoder by itself.
        """
        world = self._world
        sigmas = {"inertia_sigma": world.inertia_sigma, "friction_sigma": world.friction_sigma}
        plant = self._settings.plant.model_copy(update=sigmas)
        settings = self._settings.model_copy(update={"plant": plant})
        return draw_trials(count, settings, self.seed, self.stream, 1.0, first)

    def loop(self) -> "TwinLoop":
        """Return a closed loop for `reset`."""
        return TwinLoop(self)

    def run_piece(
        self, policy: PolicyKernel, trials: Trials, rows: Sequence[int], duration: float
    ) -> None:
        """Run trials of a compiled policy in this thread; see `Simulation.run`."""
        max_steps = round(duration / self.params[0].h)
        try:
            loop = self._idle.pop()  # of a thread that has finished
        except IndexError:
            loop = self.loop()
        for row in rows:
            result = loop.run(policy, trials.trial(row), max_steps)
            trials.steps[row], trials.cause[row], trials.sum_x2[row] = result
        self._idle.append(loop)

    def pendulum(self, trial: Trial) -> PendulumParameters:
        """Return the pendulum of a trial, with the friction that acts in the twin."""
        own = trial.variation
        varied = scaled(self._nominal, own.inertia_factor, own.friction_factor)
        return self._friction.on(varied)

    def twin(self) -> Twin:
        """Return a twin for `Twin.set_trial`."""
        return Twin(self._arm, self._nominal, self._world, servo=self._servo)

    def monitors(self) -> list[TrialSafetyMonitor]:
        """Return the rules of the world for one trial, with each actuator."""
        return [new_trial_monitor(self._arm, safety) for safety in self._safety]


class TwinLoop:
    """Closed loop on a twin, which the trials use in turn.

    A controller with several actuators is told none: before the release, with the pendulum hanging,
    the arm makes the move of the self-test, and its setpoints and measured joints select one.
    """

    def __init__(self, simulation: TwinSimulation) -> None:
        """Build the twin, and allocate the controller."""
        self._simulation, self._twin = simulation, simulation.twin()
        self.params, self.controller = simulation.params[0], new_controller_state()
        self.now, self.tracked = 0.0, 0.0
        self.zero: float | None = None
        twin, q = self._twin.kernel, np.zeros(FREE_JOINTS)
        # The twin owns the memory of the engine and has to outlive the handles.
        self._handles: list[Any] = [
            new_twin_handle(TwinTrial(twin, params, self.controller, q, monitor))
            for params, monitor in zip(simulation.params, simulation.monitors(), strict=True)
        ]
        self._handle = self._handles[0]
        self.chosen = 0

    def run(self, policy: PolicyKernel, trial: Trial, max_steps: int) -> TrialResult:
        """Run a trial of a compiled policy; see `trial.run_trial`."""
        self._set(trial)
        _, _, phi, phi_dot = trial.start
        return run_twin(self._handle, policy, phi, phi_dot, max_steps)

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        self._set(trial)
        _, _, phi, phi_dot = trial.start
        release_twin(self._handle, phi, phi_dot)
        self._state, self.now, self.tracked = np.array(self._twin.truth()), 0.0, 0.0

    def _set(self, trial: Trial) -> None:
        self.pendulum = self._simulation.pendulum(trial)
        self._twin.set_trial(self.pendulum, self._simulation.seed, trial.number)
        if (move := self._simulation.move) is not None:
            self._select(move)
        self.zero = float(self._twin.kernel.sensors.zero[0])

    def _select(self, move: Array) -> None:
        """Make a move with the hanging pendulum, and select the actuator from it."""
        twin, record = self._twin, MotionRecord()
        twin.reset()
        for q in move:
            record.send(twin.now, q)
            twin.send(q)
            twin.advance(self.params.h / SETPOINTS_PER_TICK)
            measured, stamp = twin.measured()
            record.measure(stamp, measured)
        chosen = choose_actuator(self._simulation.actuators, *record.values()).chosen
        self.params, self._handle = self._simulation.params[chosen], self._handles[chosen]
        self.chosen = chosen

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        self.controller.u[0] = u
        x_dot = self._state[1]
        cause = int(advance_twin(self._handle, self._state))
        self.tracked, self.now = float(self._state[1] - x_dot) / self.params.h, self._twin.now
        return cause

    def push(self, rate: float) -> None:
        """Push the pendulum, which changes its rate [rad/s]."""
        bodies = self._twin.kernel.bodies
        bodies.qvel[len(self._twin.kernel.home)] += rate

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return self._state.copy()

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        bodies = self._twin.kernel.bodies
        return bodies.qpos[: len(self._twin.kernel.home)].copy()

    def measurement(self) -> Measurement:
        """Return the newest measurements."""
        return Measurement(*self._twin.encoder(), *self._twin.measured())
