"""Trials on the twin: how they end, and that the compiled loop is the one written in Python."""

from math import pi, radians

import numpy as np
import pytest

from equipoise.control.baselines import lqr_gains
from equipoise.control.boxes import ANGLE, SAFETY_STOP, TRACK, TRUNCATED, boxes
from equipoise.control.control_step import (
    command,
    make_controller_params,
    new_controller_state,
    observe,
    start_controller,
)
from equipoise.control.policy import LINEAR, RANDOM, act, policy_kernel
from equipoise.control.safety import T1_SPEED, Rule
from equipoise.control.safety import TRACK_LIMIT as TRACK_LIMIT
from equipoise.control.stop import ramp
from equipoise.control.trial_safety import guard_named, new_trial_monitor, trial_safety
from equipoise.devices.twin.trial import (
    Trial,
    TrialRecord,
    new_trial_record,
    record_trial,
    run_over_cores,
    run_trial,
)
from equipoise.devices.twin.twin import Twin
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import TWIST
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.sim_configs import TwinSettings
from equipoise.settings import Settings

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=7.16, c=0.15)
WORLD = TwinSettings()
WATCHING = new_trial_monitor(ARM, None)
LQR = policy_kernel(LINEAR, gains=lqr_gains(PENDULUM, 0.01))
STILL = policy_kernel(LINEAR)
TRIALS = [
    Trial(i, PENDULUM._replace(c=0.1 + 0.02 * i), sign * radians(1.5 + 0.2 * i), sign * radians(9))
    for i, sign in enumerate((1.0, -1.0, -1.0, 1.0))
]

pytestmark = pytest.mark.compiled_only


@pytest.fixture(scope="module")
def controller():
    actuator = Actuator.assumed("kst", delay=0.0105, lag=0.008)
    return make_controller_params(ARM, Settings(), actuator, PENDULUM, h=0.01, counts_per_rev=8192)


def run(controller, policy, trials=TRIALS, duration=2.0, workers=1, seed=1, world=WORLD):
    return run_over_cores(
        ARM, world, controller, policy, trials, duration=duration, seed=seed, workers=workers
    )


def test_a_regulator_stands_and_who_does_nothing_falls(controller):
    for outcome in run(controller, LQR, duration=5.0):
        assert (outcome.steps, outcome.cause) == (500, TRUNCATED)
        assert outcome.sum_x2 < 500 * 0.03**2
    for outcome in run(controller, STILL):
        assert outcome.cause == ANGLE
        assert 10 < outcome.steps < 60


def test_who_runs_away_ends_on_the_track_limit(controller):
    x, x_dot, phi, phi_dot = lqr_gains(PENDULUM, 0.01)
    away = policy_kernel(LINEAR, gains=(-3.0 * x, x_dot, phi, phi_dot))
    assert TRACK in {outcome.cause for outcome in run(controller, away)}


def test_outcomes_depend_on_seed_and_number_alone(controller):
    chance = policy_kernel(RANDOM)
    for policy in (LQR, chance):
        alone = run(controller, policy)
        assert run(controller, policy, workers=3) == alone
        assert run(controller, policy, trials=TRIALS[::-1]) == alone[::-1]
        assert run(controller, policy, seed=2) != alone
    renumbered = [trial._replace(number=trial.number + 10) for trial in TRIALS]
    assert run(controller, chance, trials=renumbered) != run(controller, chance)


def test_each_finished_trial_is_told(controller):
    told = {}
    run_over_cores(
        ARM, WORLD, controller, STILL, TRIALS, duration=1.0, seed=1, workers=2,
        done=lambda trial, outcome: told.update({trial.number: outcome}),
    )  # fmt: skip
    assert [told[i] for i in range(4)] == run(controller, STILL, duration=1.0)


def test_a_recorded_trial_is_the_loop_as_python_writes_it(controller):
    trial, steps = TRIALS[1], 150
    twin = Twin(ARM, trial.pendulum, WORLD, seed=3, index=1)
    rows = new_trial_record(steps, 7)
    start = (trial.phi, trial.phi_dot)
    outcome = run_trial(
        twin.kernel, controller, new_controller_state(), LQR, *start, steps, boxes(), WATCHING, rows
    )
    assert (outcome.steps, outcome.cause) == (steps, TRUNCATED)

    memory, sum_x2 = new_controller_state(), 0.0
    twin = Twin(ARM, trial.pendulum, WORLD, seed=3, index=1)
    twin.reset(phi=trial.phi, phi_dot=trial.phi_dot)
    counts, stamp = twin.encoder()
    shown = pi - counts * 2 * pi / 8192 - stamp * trial.phi_dot
    start_controller(controller, memory, 0.0, 0.0, shown, trial.phi_dot, 0)
    for row in range(steps):
        seen = memory.observation[::BATCH_SIZE].copy()
        memory.u[0] = act(LQR, *seen, 0.0)
        measured, measured_at = twin.measured()
        assert rows.observation[row] == pytest.approx(seen, abs=1e-12)
        assert rows.u[row] == pytest.approx(memory.u[0], abs=1e-12)
        assert rows.estimate[row] == pytest.approx(memory.estimate[::BATCH_SIZE], abs=1e-12)
        assert rows.counts[row] == pytest.approx(twin.encoder(), abs=1e-12)
        assert rows.measured[row] == pytest.approx([*measured, measured_at], abs=1e-12)
        assert rows.truth[row] == pytest.approx(twin.truth(), abs=1e-12)
        assert rows.q[row] == pytest.approx(twin.data.qpos[:7], abs=1e-12)
        command(controller, memory, 1)
        setpoints = memory.setpoints[::BATCH_SIZE]
        commanded = [*memory.q[::BATCH_SIZE], *memory.dq[::BATCH_SIZE]]
        assert rows.setpoints[row] == pytest.approx(setpoints, abs=1e-12)
        assert rows.command[row] == pytest.approx(commanded, abs=1e-12)
        for half in (setpoints[:6], setpoints[6:]):
            twin.send(half)
            twin.advance(0.005)
        memory.counts[0], counted = twin.encoder()
        memory.measured[::BATCH_SIZE], measured_at = twin.measured()
        observe(controller, memory, twin.now - counted, twin.now - measured_at, 1)
        sum_x2 += twin.truth().x ** 2
    assert outcome.sum_x2 == pytest.approx(sum_x2, rel=1e-9)


def test_the_estimate_is_near_the_truth(controller):
    steps = 500
    twin = Twin(ARM, PENDULUM, WORLD, seed=3)
    rows = new_trial_record(steps, 7)
    run_trial(
        twin.kernel,
        controller,
        new_controller_state(),
        LQR,
        0.03,
        0.15,
        steps,
        boxes(),
        WATCHING,
        rows,
    )
    late = slice(steps // 2, None)
    phi, phi_dot, bias, v = (rows.estimate[late] - rows.truth[late][:, [2, 3, 2, 1]]).T
    del bias
    assert np.abs(phi).max() < radians(0.5)
    assert np.abs(phi_dot).max() < radians(15.0)
    assert np.abs(v).max() < 0.05
    # What it takes for the encoder's zero error is that.
    assert rows.estimate[-1, 2] == pytest.approx(twin.kernel.sensors.zero, abs=radians(0.1))


def test_a_record_ends_with_its_trial(controller):
    trial, world = TRIALS[0], WORLD.model_copy(update={"zero_offset": 0.01})
    outcome, rows, zero = record_trial(
        ARM, world, controller, STILL, trial.pendulum,
        phi=trial.phi, phi_dot=trial.phi_dot, duration=2.0, seed=1,
    )  # fmt: skip
    assert outcome == run(controller, STILL, trials=[trial], world=world)[0]
    assert {len(column) for column in rows} == {outcome.steps}
    assert rows.truth[0] == pytest.approx([0.0, 0.0, trial.phi, trial.phi_dot], abs=1e-12)
    assert radians(9.0) < abs(rows.truth[-1, 2]) < radians(11.0)
    assert abs(zero - 0.01) <= world.zero_error


# Guards.


def run_until_the_guard(controller, policy, guard, number=0, seconds=5.0):
    """Return a twin, the memory of its controller and the outcome of its trial."""
    trial = TRIALS[number]
    twin = Twin(ARM, trial.pendulum, WORLD, seed=3, index=number)
    memory, rows = new_controller_state(), new_trial_record(round(seconds / 0.01), 7)
    outcome = run_trial(
        twin.kernel, controller, memory, policy, trial.phi, trial.phi_dot, len(rows.u), boxes(),
        new_trial_monitor(ARM, guard), rows,
    )  # fmt: skip
    return twin, memory, outcome, TrialRecord(*(row[: outcome.steps] for row in rows))


@pytest.fixture(scope="module")
def guard():
    actuator = Actuator.assumed("kst", delay=0.0105, lag=0.008)
    return trial_safety(ARM, TwinSettings(guards=True), actuator, LQR, 0.01)


@pytest.fixture(scope="module")
def away():
    """A regulator that wants to be elsewhere than at home."""
    x, x_dot, phi, phi_dot = lqr_gains(PENDULUM, 0.01)
    return policy_kernel(LINEAR, gains=(-3.0 * x, x_dot, phi, phi_dot))


def test_a_run_towards_the_end_of_the_track_is_stopped_in_time(controller, guard, away):
    ended = 0
    for number in range(len(TRIALS)):
        twin, memory, outcome, rows = run_until_the_guard(controller, away, guard, number)
        if guard_named(outcome.cause) != Rule.TRACK.value:
            continue
        ended += 1
        x = twin.truth().x
        assert max(abs(rows.truth[:, 0]).max(), abs(x)) < TRACK_LIMIT
        # The verdict is that of the rule, and came as soon as it could.
        q, dq = (ARM.with_held(block[::BATCH_SIZE]) for block in (memory.q, memory.dq))
        dq[ARM.held_joint - 1] = 0.0
        slowing = ramp(
            q.tolist(), dq.tolist(), abs(memory.reference[TWIST * BATCH_SIZE]), guard.limits
        )
        furthest, time = abs(x), 0.0
        while time < slowing.duration + 0.2:
            time += 0.005
            twin.send(np.array(ARM.without_held(slowing.at(time))))
            twin.advance(0.005)
            furthest = max(furthest, abs(twin.truth().x))
        assert abs(twin.truth().x_dot) < 0.02
        assert furthest < TRACK_LIMIT
        # No braver than it has to be, no more timid either.
        assert furthest > 0.8 * TRACK_LIMIT
    assert ended > 1


def test_a_guard_ends_nothing_that_stands_and_changes_no_bit_of_it(controller, guard):
    free = run(controller, LQR)
    held = run_over_cores(
        ARM, WORLD, controller, LQR, TRIALS, duration=2.0, seed=1, workers=1, guard=guard
    )
    assert held == free


def test_until_a_guard_ends_it_a_trial_is_the_same(controller, guard, away):
    _, _, stopped, held = run_until_the_guard(controller, away, guard)
    _, _, outcome, free = run_until_the_guard(controller, away, None)
    assert outcome.cause < SAFETY_STOP <= stopped.cause
    assert stopped.steps <= outcome.steps
    for with_guard, without in zip(held, free, strict=True):
        assert np.array_equal(with_guard, without[: stopped.steps])


def test_the_limit_of_t1_ends_a_trial_that_is_too_fast(controller, guard, away):
    t1 = guard._replace(speed=T1_SPEED)
    ended = [run_until_the_guard(controller, away, t1, number)[2] for number in range(4)]
    assert Rule.SPEED.value in {guard_named(outcome.cause) for outcome in ended}


def test_a_pendulum_that_seems_to_have_fallen_ends_a_trial(controller, guard):
    # What the encoder reads too much makes the estimate reach the limit before the truth does.
    world = WORLD.model_copy(update={"zero_error": 0.0, "zero_offset": radians(2.0)})
    leaning = TRIALS[0]._replace(phi=radians(2.0), phi_dot=radians(15.0))
    outcome = run_over_cores(
        ARM, world, controller, STILL, [leaning], duration=2.0, seed=1, workers=1, guard=guard
    )[0]
    assert guard_named(outcome.cause) == Rule.ANGLE.value


def test_an_arm_that_is_elsewhere_than_expected_ends_a_trial(controller, guard):
    # A transport of 150 ms that nobody has told the controller of.
    world = WORLD.model_copy(update={"transport": 0.15})
    outcomes = run_over_cores(
        ARM, world, controller, LQR, TRIALS, duration=2.0, seed=1, workers=1, guard=guard
    )
    assert Rule.FOLLOWING.value in {guard_named(outcome.cause) for outcome in outcomes}


def test_a_setpoint_that_may_not_be_sent_ends_a_trial_before_it_is_sent(controller, guard):
    slow = guard._replace(
        limits=guard.limits._replace(acceleration=tuple(0.5 for _ in guard.limits.acceleration))
    )
    twin, _, outcome, rows = run_until_the_guard(controller, LQR, slow)
    assert guard_named(outcome.cause) == Rule.ACCELERATION.value
    assert outcome.steps == 1
    assert twin.now == 0.0
    assert rows.u[0] != 0.0
