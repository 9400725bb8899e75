"""Trials on the digital twin: worlds `twin:NAME` and `twin:FILE`.

The control step is the one of training and deployment: measurements become the observation, its u
becomes two setpoints. Controller, servo, arm, pendulum and sensors run in one kernel. The true
state decides how a trial ends; in a world with guards, the rules of a rig end it as well, from the
rig's measurements. A trial depends on its conditions, the master seed and its number alone.
"""

from math import inf, pi
from typing import ClassVar, NamedTuple

import numpy as np

from equipoise.arm.arm import FREE_JOINTS
from equipoise.arrays import Array, IntArray, Records, new_records, rows_of
from equipoise.control.control_step import (
    SETPOINTS_PER_TICK,
    ControllerParams,
    horizon,
    make_controller_params,
    wrapped,
)
from equipoise.control.policy import Observation
from equipoise.control.swing_up import SwingUp, make_swing_up
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import call, inlined
from equipoise.model.grid import SAFETY_STOP, TRUNCATED
from equipoise.model.worlds import World, pendulum_on, read_world
from equipoise.safety.rules import NO_VIOLATION, make_safety_params
from equipoise.safety.trial import (
    TrialSafetyMonitor,
    new_trial_monitor,
    reset_trial_monitor,
    setpoint_violation,
    trial_violation,
)
from equipoise.simulation.interface import CompiledLoop, Measurement, Setup, Simulation
from equipoise.simulation.plant import BatchState, Trial, failure, observed, scaled
from equipoise.simulation.trials import kernels_of
from equipoise.simulation.twin.physics import TICK
from equipoise.simulation.twin.twin import Twin, advance, encoder, reply, reset, send_free, truth


class TwinWorld(NamedTuple):
    """The twin as a world of compiled trials, one at a time."""

    twins: Records
    """The twin, see `Twin.args`."""
    arrays: Records
    """Arrays of its engine, likewise."""
    params: ControllerParams
    """Constants of the controller."""
    states: Records
    """`BatchState`, of which the twin uses controller, swing-up, state, time and cause."""
    rows: IntArray
    """Its rows of lanes, from `rows_of`."""
    q: Array
    """Scratch array: free joints [rad], shape (6,)."""
    monitor: TrialSafetyMonitor
    """Rules of the world with their state."""
    swing_up: SwingUp
    """Swing-up of trials that begin with a hanging pendulum."""
    seed: int
    """Seed of a policy that acts at random."""
    stream: int
    """Stream of its random numbers."""
    batch_size: int = 1
    """Number of trials that run side by side."""


@inlined
def release(world: TwinWorld, trial: Trial, n: int) -> None:
    """Release the pendulum, the arm at rest at home; the controller has observed it until now.

    Args:
        world: Changed in place; its pendulum is that of the trial.
        trial: The trial; its x, x_dot and variation are not used.
        n: Lane, the first one.
    """
    twin, params, batch = world.twins[0], world.params, world.states[0]
    _, _, phi, phi_dot = trial.start
    reset(twin, world.arrays[0], twin.home, phi, phi_dot)
    counts, stamp = encoder(twin)
    shown = pi - counts * params.resolution - stamp * phi_dot
    measured = Observation(0.0, 0.0, shown, phi_dot)
    call(params.start_controller, (params, batch.controller, measured, n))
    reset_trial_monitor(world.monitor, params.home)
    _read_truth(world)


@inlined
def _read_truth(world: TwinWorld) -> None:
    real, batch = truth(world.twins[0], world.arrays[0]), world.states[0]
    state = batch.state
    batch.time[0] = world.twins[0].now * TICK
    batch.u_tracked[0] = (real.x_dot - state.x_dot[0]) / world.params.h
    state.x[0], state.x_dot[0], state.phi[0], state.phi_dot[0] = real
    state.phi[0] = wrapped(state.phi[0])


@inlined
def step(world: TwinWorld, seed: IntArray, tick: IntArray, number: IntArray, lanes: int) -> None:
    """Send the setpoints for u; at the end of the step observe, and decide about a failure.

    Args:
        world: The state of its controller holds u; changed in place.
        seed: Not used: the twin knows its seed.
        tick: Not used: the twin counts its milliseconds, and knows the number of its trial.
        number: Not used.
        lanes: Not used: there is one.
    """
    twin, data, params, monitor = world.twins[0], world.arrays[0], world.params, world.monitor
    batch, q = world.states[0], world.q
    controller = batch.controller
    call(params.command, (params, controller, 1))
    for s in range(SETPOINTS_PER_TICK):
        for i in range(FREE_JOINTS):
            q[i] = controller.setpoints[s, i, 0]
        if monitor.active:
            broken = setpoint_violation(monitor, q, twin.now * TICK)
            if broken != NO_VIOLATION:
                _read_truth(world)
                batch.cause[0] = SAFETY_STOP + broken
                return
        send_free(twin, q)
        advance(twin, data, round(params.h / SETPOINTS_PER_TICK / TICK))
    now = twin.now
    counts, counted = encoder(twin)
    measured = reply(twin, q)
    controller.counts[0] = counts
    for i in range(FREE_JOINTS):
        controller.measured[i, 0] = q[i]
    ages = now * TICK - counted, now * TICK - measured
    call(params.observe, (params, controller, ages, 1))
    _read_truth(world)
    exceeded, balancing = controller.limit_exceeded[0] != 0, controller.balancing[0] != 0
    cause = failure(observed(batch.state, 0), exceeded, inf, balancing)
    if cause == TRUNCATED and monitor.active:
        broken = trial_violation(monitor, params, controller, q, measured)
        if broken != NO_VIOLATION:
            cause = SAFETY_STOP + broken
    batch.cause[0] = cause


class TwinSimulation(Simulation):
    """Trials on a digital twin."""

    PIECE: ClassVar[int] = 1

    def __init__(self, world: str | World, setup: Setup, *, seed: int, stream: int) -> None:
        """Set up a simulation; see `Simulation`.

        Raises:
            ArmError: The masses of the arm's links are unknown, or home is a singular posture.
            SettingsError: The world does not exist, or the delay exceeds the controller's history.
        """
        world = world if isinstance(world, World) else read_world(world)
        # I and b vary by the numbers of the twin; it draws jitter, noise and zero error by itself.
        sigmas = world.settings.model_dump(include={"inertia_sigma", "friction_sigma"})
        plant = setup.settings.plant.model_copy(update=sigmas)
        setup = setup._replace(settings=setup.settings.model_copy(update={"plant": plant}))
        super().__init__(world, setup, seed=seed, stream=stream)
        numbers = self.twin = self.numbers = world.settings
        arm, settings, actuator, h = setup.arm, setup.settings, setup.actuator, setup.h
        self.params = make_controller_params(
            arm, settings, actuator, self.pendulum, h=h, counts_per_rev=numbers.counts_per_rev
        )
        """Constants of the controller."""
        self.max_speed = min(self.max_speed, numbers.max_speed or inf)
        reaction = horizon(arm, actuator, 0.0)
        self.safety = make_safety_params(arm, reaction=reaction, h=h, speed=self.max_speed)
        """Safety limits of a trial: those of a rig."""

    def loop(self) -> "TwinLoop":
        """Return a closed loop for `reset`."""
        return TwinLoop(self)


class TwinLoop(CompiledLoop):
    """Closed loop on a twin, which the trials use in turn."""

    KERNELS = kernels_of(release, step)

    def __init__(self, simulation: TwinSimulation) -> None:
        """Build the twin, and allocate the controller."""
        arm, params, self._numbers = simulation.setup.arm, simulation.params, simulation.numbers
        self._twin = Twin(arm, simulation.pendulum, self._numbers)
        states, active = new_records(BatchState), self._numbers.guards
        monitor = new_trial_monitor(arm, simulation.safety, active=active)
        rows, q = rows_of(states, BATCH_SIZE), np.zeros(FREE_JOINTS)
        law = make_swing_up(params, simulation.max_speed)
        world = TwinWorld(*self._twin.args, params, states, rows, q, monitor, law, 0, 0)
        super().__init__(simulation, params, world)

    def prepare(self, trial: Trial) -> TwinWorld:
        """Return the world with the pendulum of a trial, before its release."""
        simulation = self.simulation
        varied = scaled(simulation.pendulum, trial.variation)
        self.pendulum = pendulum_on(simulation.setup.pendulum, self._numbers, varied)
        self._twin.set_trial(self.pendulum, simulation.seed, trial.number)
        self.zero = float(self._twin.state.zero)
        return self._world._replace(seed=simulation.seed, stream=simulation.stream)

    def push(self, rate: float) -> None:
        """Push the pendulum, which changes its rate [rad/s]."""
        self._twin.data.qvel[-1] += rate

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        return self._twin.data.qpos[:-1].copy()

    def measurement(self) -> Measurement:
        """Return the newest measurements."""
        return Measurement(*self._twin.encoder(), *self._twin.measured())
