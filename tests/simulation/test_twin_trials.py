"""Trials on the twin: how they end, and that the compiled loop is the one written in Python."""

from math import pi, radians

import numpy as np
import pytest

from equipoise import Actuator, Pendulum, Settings, iiwa, simulate_run
from equipoise.arm.compiler import TWIST
from equipoise.arrays import fields, first_lane, new_records
from equipoise.control import controller
from equipoise.control.control_step import ControllerState
from equipoise.control.linear import lqr_gains
from equipoise.control.policy import LINEAR, RANDOM, KernelPolicy, Observation, PolicyKernel, act
from equipoise.model.grid import ANGLE, TRUNCATED
from equipoise.model.random import TEST
from equipoise.model.worlds import CLEAN, TwinSettings, World
from equipoise.outcomes import TRIAL_OUTCOMES, Outcome
from equipoise.safety.rules import TRACK_LIMIT
from equipoise.safety.stop import ramp
from equipoise.simulation import Setup, Trial, TrialRecorder, run_trial
from equipoise.simulation.plant import DomainRandomization
from equipoise.simulation.trials import draw_trials
from equipoise.simulation.twin.twin import Twin
from equipoise.simulation.twin.world import TwinSimulation
from tests.simulation.recorded import record, run_all

ARM = iiwa(7)
PENDULUM = Pendulum.assumed(70.2, 0.15)
PARAMETERS = PENDULUM.parameters()
WORLD = TwinSettings(guards=False)
GUARDED = TwinSettings(guards=True)
ACTUATOR = Actuator.assumed("kst", delay=0.0105, lag=0.008)
LQR = PolicyKernel(LINEAR, gains=lqr_gains(PARAMETERS, 0.01))
STILL = PolicyKernel(LINEAR)
TRIALS = [
    Trial(
        i,
        (0.0, 0.0, sign * radians(1.5 + 0.2 * i), sign * radians(9)),
        DomainRandomization(1.0, (0.1 + 0.02 * i) / 0.15, 0.0, 1.0, 0.0),
    )
    for i, sign in enumerate((1.0, -1.0, -1.0, 1.0))
]


def twins(world=WORLD, seed=1):
    setup = Setup(PENDULUM, ARM, Settings(), ACTUATOR, 0.01)
    return TwinSimulation(World("twin:test", world), setup, seed=seed, stream=TEST)


def run(policy, trials=TRIALS, duration=2.0, workers=1, seed=1, world=WORLD):
    """Return steps, cause and sum of x^2 of some trials."""
    drawn = draw_trials(len(trials), Settings(), 0, TEST)
    for row, trial in enumerate(trials):
        drawn.number[row], drawn.start[row], drawn.variation[row] = trial
    run_all(twins(world, seed), policy, drawn, duration, workers)
    beyond = np.abs(drawn.end[:, 2]) >= np.radians(11.0)
    np.testing.assert_array_equal(beyond, drawn.cause == ANGLE)
    return list(zip(drawn.steps, drawn.cause, drawn.sum_x2, strict=True))


def test_a_regulator_stands_and_who_does_nothing_falls():
    for steps, cause, sum_x2 in run(LQR, duration=5.0):
        assert (steps, cause) == (500, TRUNCATED)
        assert sum_x2 < 500 * 0.03**2
    for steps, cause, _ in run(STILL):
        assert cause == ANGLE
        assert 10 < steps < 60


def test_behind_an_ideal_actuator_the_observed_velocity_is_the_slope_of_the_observed_x():
    clean = World("twin:clean", TwinSettings().model_copy(update=CLEAN))
    run = simulate_run("lqr", world=clean, actuator="ideal", duration=2.0)
    x, x_dot = run.ticks.x, run.ticks.x_dot
    moved = 0.005 * np.cumsum(x_dot[1:] + x_dot[:-1])  # exact for a u that is held
    assert np.ptp(moved) > 0.02
    np.testing.assert_allclose(x[1:] - x[0], moved, atol=1e-3)


def test_outcomes_depend_on_seed_and_number_alone():
    chance = PolicyKernel(RANDOM)
    for policy in (LQR, chance):
        alone = run(policy)
        assert run(policy, workers=3) == alone
        assert run(policy, trials=TRIALS[::-1]) == alone[::-1]
        assert run(policy, seed=2) != alone
    renumbered = [trial._replace(number=trial.number + 10) for trial in TRIALS]
    assert run(chance, trials=renumbered) != run(chance)


def test_a_recorded_trial_is_the_loop_as_python_writes_it():
    trial, steps = TRIALS[1], 150
    simulation = twins(seed=3)
    outcome, rows = record(simulation, KernelPolicy(LQR), trial, 0.01 * steps)
    assert outcome[:2] == (steps, TRUNCATED)

    params, records, sum_x2 = simulation.params, new_records(ControllerState), 0.0
    memory = fields(records, ControllerState)
    pendulum = PARAMETERS._replace(c=0.15 * trial.variation.friction_factor, coulomb=0.1)
    _, _, phi, phi_dot = trial.start
    twin = Twin(ARM, pendulum, WORLD)
    twin.set_trial(pendulum, 3, 1)
    twin.reset(phi=phi, phi_dot=phi_dot)
    counts, stamp = twin.encoder()
    shown = pi - counts * 2 * pi / 8192 - stamp * phi_dot
    controller.start(params, records, Observation(0.0, 0.0, shown, phi_dot))
    for row in range(steps):
        observation = first_lane(memory.observation)
        memory.u[0] = act(LQR, observation, 0.0)
        measured, measured_at = twin.measured()
        assert rows.observation[row] == pytest.approx(observation, abs=1e-12)
        assert rows.u[row] == pytest.approx(memory.u[0], abs=1e-12)
        assert rows.estimate[row] == pytest.approx(first_lane(memory.estimate))
        assert rows.encoder[row] == pytest.approx(twin.encoder(), abs=1e-12)
        assert rows.measured[row] == pytest.approx([*measured, measured_at], abs=1e-12)
        assert rows.state[row] == pytest.approx(twin.truth(), abs=1e-12)
        assert rows.joints[row] == pytest.approx(twin.data.qpos[:7], abs=1e-12)
        controller.call_alone(params.command, params, records)
        setpoints = memory.setpoints[:, :, 0]
        assert rows.setpoints[row] == pytest.approx(setpoints.ravel(), abs=1e-12)
        assert rows.q[row] == pytest.approx(memory.q[:, 0], abs=1e-12)
        assert rows.dq[row] == pytest.approx(memory.dq[:, 0], abs=1e-12)
        x_dot = twin.truth().x_dot
        for half in setpoints:
            twin.send(half)
            twin.advance(0.005)
        assert rows.tracked[row] == pytest.approx((twin.truth().x_dot - x_dot) / 0.01)
        memory.counts[0], counted = twin.encoder()
        memory.measured[:, 0], measured_at = twin.measured()
        ages = twin.now - counted, twin.now - measured_at
        controller.observe_tick(params, records, ages)
        sum_x2 += twin.truth().x ** 2
    assert outcome[2] == pytest.approx(sum_x2, rel=1e-9)


# Guards.


def run_until_the_guard(policy, simulation, number=0):
    """Return the closed loop after a trial, its cause and its record."""
    loop, recorder = simulation.loop(), TrialRecorder()
    cause = run_trial(loop, KernelPolicy(policy), TRIALS[number], 5.0, recorder).cause
    return loop, cause, recorder.rows


def test_a_run_towards_the_end_of_the_track_is_stopped_in_time():
    # A regulator that wants to be elsewhere than at home.
    on_x, *others = lqr_gains(PARAMETERS, 0.01)
    away = PolicyKernel(LINEAR, gains=(-3.0 * on_x, *others))
    ended, simulation = 0, twins(GUARDED, seed=3)
    for number in range(len(TRIALS)):
        loop, cause, rows = run_until_the_guard(away, simulation, number)
        if TRIAL_OUTCOMES[cause] != Outcome.TRACK:
            continue
        ended += 1
        memory, twin, x = loop.controller, loop._twin, loop.state()[0]
        assert max(abs(rows.state[:, 0]).max(), abs(x)) < TRACK_LIMIT
        # The verdict is that of the rule, and came as soon as it could.
        q, dq = (ARM.with_held(block[:, 0]) for block in (memory.q, memory.dq))
        dq[ARM.held_joint - 1] = 0.0
        speed, limits = abs(memory.reference[TWIST, 0]), simulation.safety.limits
        slowing = ramp(q.tolist(), dq.tolist(), speed, limits)
        furthest, time = abs(x), 0.0
        while time < slowing.duration + 0.2:
            time += 0.005
            twin.send(np.array(ARM.without_held(slowing.at(time).q)))
            twin.advance(0.005)
            furthest = max(furthest, abs(twin.truth().x))
        assert abs(twin.truth().x_dot) < 0.02
        assert furthest < TRACK_LIMIT
        # No braver than it has to be, no more timid either.
        assert furthest > 0.8 * TRACK_LIMIT
    assert ended > 1


def test_a_guard_ends_nothing_that_stands_and_changes_no_bit_of_it():
    assert run(LQR, world=GUARDED) == run(LQR)


def test_an_arm_that_is_elsewhere_than_expected_ends_a_trial():
    # A transport of 150 ms that nobody has told the controller of.
    world = GUARDED.model_copy(update={"transport": 0.15})
    assert Outcome.FOLLOWING in {TRIAL_OUTCOMES[cause] for _, cause, _ in run(LQR, world=world)}


def test_a_setpoint_that_may_not_be_sent_ends_a_trial_before_it_is_sent():
    simulation = twins(GUARDED, seed=3)
    limits = simulation.safety.limits
    slow = limits._replace(acceleration=tuple(0.5 for _ in limits.acceleration))
    simulation.safety = simulation.safety._replace(limits=slow)
    loop, cause, rows = run_until_the_guard(LQR, simulation)
    assert TRIAL_OUTCOMES[cause] == Outcome.ACCELERATION
    assert len(rows.u) == 1
    assert loop._twin.now == 0.0
    assert rows.u[0] != 0.0
