"""The swing-up, on a pendulum that SciPy integrates, and in the worlds."""

from math import cos, inf, pi, radians, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from equipoise import PendulumParameters, bind_policy, evaluate, paper
from equipoise.arrays import fields, new_records
from equipoise.control import swing_up
from equipoise.control.linear import baselines
from equipoise.control.policy import LINEAR, KernelPolicy, PolicyKernel, shipped_policy
from equipoise.control.swing_up import SwingUp, SwingUpPolicy, SwingUpState, time_limit
from equipoise.errors import InputError, SettingsError
from equipoise.model.grid import NOT_UPRIGHT, TRUNCATED
from equipoise.settings import changed
from equipoise.simulation import run_trial, setup_of, simulate

PENDULUM = shipped_policy().pendulum.parameters()
LAW = SwingUp(PENDULUM, paper.STEP, 0.0, inf)
HANGING = {"evaluation.start": "hanging"}


def swung(law, pendulum, policy, seconds):
    """The states at the ticks of a swing-up of an ideal arm, and the accelerations."""
    state, rows = np.array([0.0, 0.0, pi - 0.02, 0.0]), []
    policy.reset()
    for _ in range(round(seconds / law.h)):
        wrapped = state - [0.0, 0.0, 2.0 * pi * np.floor((state[2] + pi) / (2.0 * pi)), 0.0]
        u = policy.act(wrapped)
        rows.append((*wrapped, u))
        if policy.balancing:
            break

        def motion(_, s, u=u):
            turn = pendulum.w2 * sin(s[2]) - pendulum.c * s[3] - pendulum.k * u * cos(s[2])
            return s[1], u, s[3], turn

        state = solve_ivp(motion, (0.0, law.h), state, rtol=1e-9, atol=1e-12).y[:, -1]
    return np.array(rows)


@settings(max_examples=6)
@given(st.floats(0.5, 1.4), st.floats(0.0, 0.3))
def test_any_pendulum_comes_upright_within_the_papers_limits(period, c):
    w2 = (2.0 * pi / period) ** 2
    pendulum = PendulumParameters(w2, w2 / 9.81, c, 0.0, 0.0, False)
    law = LAW._replace(pendulum=pendulum)
    policy = SwingUpPolicy(baselines(pendulum, law.h)["LQR"], law)
    rows = swung(law, pendulum, policy, time_limit(pendulum))
    assert policy.balancing
    assert np.abs(rows[:, 0]).max() < 0.9 * paper.X_LIMIT
    assert set(rows[:-1, 4]) <= {0.0, *paper.ACTIONS}


def test_it_stays_below_a_limit_of_the_speed():
    law = LAW._replace(max_speed=0.25)
    policy = SwingUpPolicy(baselines(PENDULUM, law.h)["LQR"], law)
    rows = swung(law, PENDULUM, policy, time_limit(PENDULUM))
    assert policy.balancing
    assert np.abs(rows[:, 1]).max() < 0.25


@pytest.mark.parametrize("factor", [0.95, 1.0, 1.05])
def test_swings_calibrate_the_energy(factor):
    w2 = factor * PENDULUM.w2
    true = PENDULUM._replace(w2=w2, k=w2 / 9.81)
    rows = swung(LAW, true, SwingUpPolicy(baselines(PENDULUM, LAW.h)["random"], LAW), 8.0)
    records = new_records(SwingUpState)
    state = fields(records, SwingUpState)
    swing_up.begin_swing_up(LAW, state, 0)
    for _, x_dot, phi, phi_dot, _ in rows.tolist():
        swing_up.calibrate(LAW, state, (0.0, x_dot, phi, phi_dot), 0)
    assert state.w2[0] == pytest.approx(w2, rel=0.01)


@pytest.mark.parametrize(
    ("state", "saved"),
    [
        ((0.0, 0.0, 0.0, 0.0), True),
        ((0.0, 0.0, radians(4.0), -0.5), True),
        ((0.0, 0.0, radians(4.0), 0.5), False),  # it falls too fast
        ((0.0, 0.0, radians(15.0), -2.0), False),  # it is beyond the failure angle
        ((0.08, 0.4, 0.0, 0.0), False),  # it leaves the track
    ],
)
def test_it_hands_over_where_the_policy_saves_the_pendulum(state, saved):
    states = fields(new_records(SwingUpState), SwingUpState)
    assert swing_up.saves(LAW, states, shipped_policy().kernel, state, 0) is saved


@pytest.mark.parametrize(
    ("x_dot", "phi", "u"),
    [(0.29, radians(50.0), 1.0), (0.31, radians(50.0), 0.0), (-0.31, radians(130.0), -1.0)],
)
def test_above_the_pivot_it_pumps_at_speeds_at_which_the_policy_can_catch(x_dot, phi, u):
    states = fields(new_records(SwingUpState), SwingUpState)
    swing_up.begin_swing_up(LAW, states, 0)
    assert swing_up.pump(LAW, states, (0.0, x_dot, phi, -3.0), 0) == u  # too slow to come upright


@pytest.mark.parametrize("world", ["model", "twin:nominal"])
def test_a_trial_begins_hanging_and_has_the_same_bits_either_way(world):
    policy = shipped_policy()
    setup = setup_of(policy, world, changed(policy.settings, HANGING))
    simulation = simulate(world, setup, seed=4, stream=1)
    trials = simulation.draw(4)
    simulation.run(policy, trials, duration=5.0)
    assert np.all(trials.cause == TRUNCATED)
    assert np.all(trials.steps == 500)
    assert np.all((trials.upright > 200) & (trials.upright < 1500))
    loop = simulation.loop()
    end = run_trial(loop, simulation.acting(policy, loop), trials.trial(2), 5.0)
    assert end == (500, TRUNCATED, trials.sum_x2[2], trials.upright[2])
    assert np.array_equal(loop.state(), trials.end[2])


def test_a_pendulum_that_hangs_to_the_end_was_not_upright():
    policy = shipped_policy()
    setup = setup_of(policy, "model", changed(policy.settings, HANGING))
    simulation = simulate("model", setup, seed=0, stream=1)
    resting = KernelPolicy(PolicyKernel(LINEAR))
    end = run_trial(simulation.loop(), resting, simulation.draw(1).trial(0), 1.0)
    assert (end.steps, end.cause, end.upright) == (0, NOT_UPRIGHT, 1500)


def test_what_no_swing_up_can_end_with_is_refused():
    few = {"evaluation.trials": 1}
    policy = bind_policy(lambda _: 0.0)
    with pytest.raises(InputError, match="no swing-up can end with"):
        evaluate(policy, changed(policy.settings, HANGING | few))
    with pytest.raises(SettingsError, match="does not hang"):
        evaluate(settings=changed(policy.settings, HANGING | few | {"plant.linearised": True}))
