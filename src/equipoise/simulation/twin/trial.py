"""Trials of a policy on the twin: controller, servo, arm, pendulum and sensors in one kernel.

The control step is the one of training and deployment: measurements become the observation, its u
becomes two setpoints. The true state decides how a trial ends; in a world with guards, the rules of
a rig end it as well, from the rig's measurements. A trial depends on its conditions, the master
seed and its number alone.
"""

from math import inf, pi
from typing import Annotated, Final, NamedTuple, Protocol

from equipoise import paper
from equipoise.arm.arm import FREE_JOINTS
from equipoise.arrays import Array, IntArray, Records
from equipoise.control.control_step import (
    LANES,
    SETPOINTS_PER_TICK,
    ControllerParams,
    ControllerState,
    Observed,
)
from equipoise.jit import call, inlined, kernel
from equipoise.model.grid import SAFETY_STOP, TRUNCATED
from equipoise.safety.rules import NO_VIOLATION
from equipoise.safety.trial import (
    TrialSafetyMonitor,
    reset_trial_monitor,
    setpoint_violation,
    trial_violation,
)
from equipoise.simulation.plant import DomainRandomization, FailureLimits, failure
from equipoise.simulation.trials import trial_loop
from equipoise.simulation.twin.physics import TICK
from equipoise.simulation.twin.twin import (
    advance,
    encoder,
    reply,
    reset,
    send_free,
    truth,
)

LIMITS: Final = FailureLimits(paper.PHI_LIMIT, paper.X_LIMIT, inf)
"""Limits whose violation ends a trial; the rules of a rig limit the speed."""


class TwinState(Protocol):
    """State of a closed loop on the twin, in the first lane; kernels change it in place."""

    controller: ControllerState
    """State of the controller."""
    state: Observed
    """True state."""
    cause: Annotated[IntArray, LANES]
    """Cause of failure in the last step."""


class TwinWorld(NamedTuple):
    """The twin as a world of compiled trials, one at a time."""

    twins: Records
    """The twin, see `Twin.args`."""
    arrays: Records
    """Arrays of its engine, likewise."""
    params: ControllerParams
    """Constants of the controller."""
    states: Records
    """`TwinState`."""
    rows: IntArray
    """Its rows of lanes, from `rows_of`."""
    q: Array
    """Scratch array: free joints [rad], shape (6,)."""
    monitor: TrialSafetyMonitor
    """Rules of the world with their state."""
    seed: int
    """Seed of a policy that acts at random."""
    stream: int
    """Stream of its random numbers."""
    batch_size: int = 1
    """Number of trials that run side by side."""


@inlined
def release(
    world: TwinWorld, _: DomainRandomization, start: tuple[float, float, float, float], n: int
) -> None:
    """Release the pendulum, the arm at rest at home; the controller has observed it until now.

    Args:
        world: Changed in place; its pendulum is that of the trial.
        start: x, x_dot, phi, phi_dot at the release in SI units; the first two are not used.
        n: Lane, the first one.
    """
    twin, controller, batch = world.twins[0], world.params, world.states[0]
    phi, phi_dot = start[2], start[3]
    reset(twin, world.arrays[0], twin.home, phi, phi_dot)
    counts, stamp = encoder(twin)
    shown = pi - counts * controller.resolution - stamp * phi_dot
    begun = controller, batch.controller, 0.0, 0.0, shown, phi_dot, n
    call(controller.code.start_controller, begun)
    reset_trial_monitor(world.monitor, controller.home)
    _read_truth(world)


@inlined
def _read_truth(world: TwinWorld) -> None:
    real, state = truth(world.twins[0], world.arrays[0]), world.states[0].state
    state.x[0], state.x_dot[0], state.phi[0], state.phi_dot[0] = real


@inlined
def step(world: TwinWorld) -> int:
    """Send the setpoints for u; at the end of the step observe, and read the true state.

    Args:
        world: The state of its controller holds u; changed in place.

    Returns:
        The cause of failure, TRUNCATED without one.
    """
    twin, data, controller, monitor = world.twins[0], world.arrays[0], world.params, world.monitor
    q = world.q
    state = world.states[0].controller
    call(controller.code.command, (controller, state, 1))
    for s in range(SETPOINTS_PER_TICK):
        for i in range(FREE_JOINTS):
            q[i] = state.setpoints[s, i, 0]
        if monitor.active:
            broken = setpoint_violation(monitor, q, twin.now * TICK)
            if broken != NO_VIOLATION:
                _read_truth(world)
                return SAFETY_STOP + broken
        send_free(twin, q)
        advance(twin, data, round(controller.h / SETPOINTS_PER_TICK / TICK))
    tick = twin.now
    counts, counted = encoder(twin)
    measured = reply(twin, q)
    state.counts[0] = counts
    for i in range(FREE_JOINTS):
        state.measured[i, 0] = q[i]
    ages = tick * TICK - counted, tick * TICK - measured
    call(controller.code.observe, (controller, state, ages[0], ages[1], 1))
    _read_truth(world)
    real, exceeded = world.states[0].state, state.limit_exceeded[0] != 0
    cause = failure(real.x[0], real.x_dot[0], real.phi[0], exceeded, LIMITS)
    if cause == TRUNCATED and monitor.active:
        broken = trial_violation(monitor, controller, state, q, measured)
        if broken != NO_VIOLATION:
            return SAFETY_STOP + broken
    return cause


@inlined
def advance_step(world: TwinWorld, tick: IntArray, number: IntArray, lanes: int) -> None:
    """Advance by one step with the u of the controller; see `equipoise.simulation.trials`."""
    world.states[0].cause[0] = step(world)


run_trials = kernel(trial_loop(release, advance_step))
"""Runs trials one after the other; see `trial_loop`."""


@kernel
def release_alone(world: TwinWorld, start: tuple[float, float, float, float]) -> None:
    """Release the pendulum; see `release`."""
    release(world, DomainRandomization(1.0, 1.0, 0.0, 1.0, 0.0), start, 0)


@kernel
def advance_alone(world: TwinWorld) -> None:
    """Advance by one step; see `advance_step`."""
    world.states[0].cause[0] = step(world)
