"""The closed loop against integrators and kinematics that it does not use, and its symmetries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from equipoise.control import boxes
from equipoise.control.policy import TABLE, policy_kernel
from equipoise.learning.closed_loop import (
    ANGLE,
    CAUSES,
    JOINT_LIMIT,
    LASTED,
    PHI,
    TRACK,
    TRACKED,
    X_DOT,
    X,
    draw_noise,
    make_plant,
    new_block,
    reset,
    scaled,
    step,
)
from equipoise.learning.trials import draw_trials, record_trial, run_trials
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.elementary import LANES
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import TEST
from equipoise.settings import Settings, resolve

PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
SETTINGS = Settings()
QUIET = resolve(overrides=["plant.position_error_sigma=0", "plant.orientation_error_sigma=0"])
ARMS = pytest.mark.parametrize("size", [7, 14])


class Table:
    """A greedy table as a policy in Python, found by comparing with the interval ends."""

    def __init__(self, u_of_box):
        self.u_of_box = u_of_box

    def act(self, state):
        x, x_dot, phi, phi_dot = state
        return self.u_of_box[boxes.box_index(x, x_dot, phi, phi_dot, boxes.boxes())]


def random_table(seed=0):
    rng = np.random.default_rng(seed)
    Q = rng.normal(size=(boxes.COUNT, boxes.ACTIONS))
    # Leaning towards the fall makes trials of many lengths.
    return np.array([-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0])[boxes.greedy_actions(Q)]


@ARMS
@given(
    x=st.floats(-0.2, 0.2),
    x_dot=st.floats(-0.6, 0.6),
)
@settings(deadline=None, max_examples=25)  # the first example compiles
def test_reset_places_the_flange_on_its_track(size, x, x_dot):
    arm = iiwa(size)
    plant = make_plant(arm, QUIET, 0.01)
    block = new_block()
    lane = 3
    reset(plant, block, PENDULUM, (x, x_dot, 0.01, 0.02), lane)
    now = arm.kinematics(block.q[lane::LANES], block.dq[lane::LANES])
    home = arm.kinematics(arm.home_free)
    np.testing.assert_allclose(now.position - home.position, [x, 0.0, 0.0], atol=1e-11)
    np.testing.assert_allclose(now.rotation, home.rotation, atol=1e-11)
    np.testing.assert_allclose(now.twist, [x_dot, 0, 0, 0, 0, 0], atol=1e-11)
    np.testing.assert_allclose(
        block.state[lane : 4 * LANES : LANES], [x, x_dot, 0.01, 0.02], atol=1e-11
    )


@ARMS
def test_a_run_obeys_kinematics_and_the_pendulum_equation(size):
    """Every step again: joints by hand, flange by the arm's Python kinematics, phi by SciPy."""
    arm = iiwa(size)
    plant = make_plant(arm, SETTINGS, 0.01)
    start = np.array([0.01, -0.05, 0.02, 0.1])
    _, run = record_trial(plant, Table(random_table()), PENDULUM, start, 60, 1, TEST)
    assert len(run.u) > 15
    for i in range(len(run.u) - 1):
        before = arm.kinematics(run.q[i], run.dq[i])
        after = arm.kinematics(run.q[i + 1], run.dq[i + 1])
        tracked = (after.twist[0] - before.twist[0]) / 0.01
        assert run.tracked[i + 1] == pytest.approx(tracked, abs=1e-9)
        # Joint motion is that of a constant acceleration over the step.
        ddq = (run.dq[i + 1] - run.dq[i]) / 0.01
        np.testing.assert_allclose(
            run.q[i + 1], run.q[i] + 0.01 * run.dq[i] + 0.5 * ddq * 1e-4, atol=1e-12
        )
        if i + 2 < len(run.u):
            phi, phi_dot = run.state[i + 1][2:]
            ode = solve_ivp(
                lambda _, s, u=tracked: [
                    s[1],
                    70.2 * np.sin(s[0]) - 0.15 * s[1] - 7.15 * u * np.cos(s[0]),
                ],
                (0.0, 0.01),
                [phi, phi_dot],
                rtol=1e-11,
                atol=1e-13,
            )
            # 1e-7: a Runge-Kutta step of fourth order with w h = 0.084.
            np.testing.assert_allclose(run.state[i + 2][2:], ode.y[:, -1], atol=1e-7)
            flange = after.position[0] - arm.kinematics(arm.home_free).position[0]
            np.testing.assert_allclose(run.state[i + 2][:2], [flange, after.twist[0]], atol=1e-9)


def test_a_trial_has_the_same_bits_alone_and_in_company():
    arm = iiwa(7)
    plant = make_plant(arm, SETTINGS, 0.01)
    table = random_table(4)
    trials = draw_trials(2 * LANES + 5, SETTINGS, 7, TEST, 1.0)
    longest = 300
    kernel = policy_kernel(TABLE, u_of_box=table)
    run_trials(plant, new_block(), kernel, PENDULUM, trials, 0, len(trials.steps), longest, 7, TEST)
    assert len(set(trials.steps.tolist())) > 5
    for i in (0, 3, LANES, 2 * LANES + 4):
        own = scaled(PENDULUM, trials.inertia_factor[i], trials.friction_factor[i])
        cause, run = record_trial(plant, Table(table), own, trials.start[i], longest, 7, TEST, i)
        assert (cause, len(run.u)) == (trials.cause[i], trials.steps[i])
        x_after = np.append(run.state[1:, 0], np.nan)
        assert np.nansum(x_after**2) <= trials.sum_x2[i]


def test_lanes_do_not_depend_on_each_other():
    plant = make_plant(iiwa(7), SETTINGS, 0.01)
    together, alone = new_block(), new_block()
    rng = np.random.default_rng(0)
    starts = rng.uniform(-1.0, 1.0, (LANES, 4)) * [0.1, 0.2, 0.05, 0.3]
    for n in range(LANES):
        reset(plant, together, PENDULUM, tuple(starts[n]), n)
    reset(plant, alone, PENDULUM, tuple(starts[5]), 0)
    for _ in range(20):
        together.u[:] = rng.choice([-1.0, 1.0], LANES)
        together.noise[:] = rng.normal(size=together.noise.shape)
        alone.u[0] = together.u[5]
        alone.noise[::LANES] = together.noise[5::LANES]
        step(plant, together, LANES)
        step(plant, alone, 1)
    assert np.array_equal(together.state[5::LANES], alone.state[::LANES])
    assert np.array_equal(together.q[5::LANES], alone.q[::LANES])


@given(
    start=st.tuples(
        st.floats(-0.15, 0.15), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-0.5, 0.5)
    ),
    u=st.sampled_from([0.5, 1.0, 1.5, 2.0]),
)
@settings(deadline=None, max_examples=25)
def test_the_plant_is_mirror_symmetric(start, u):
    plant = make_plant(iiwa(7), QUIET, 0.01)
    block = new_block()
    reset(plant, block, PENDULUM, start, 0)
    reset(plant, block, PENDULUM, tuple(-value for value in start), 1)
    for _ in range(10):
        block.u[:2] = u, -u
        step(plant, block, 2)
    rows = block.state.reshape(-1, LANES)
    # 1e-9: the two postures are not images of each other to the bit.
    np.testing.assert_allclose(rows[:, 0], -rows[:, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("start", "cause"),
    [
        ((0.0, 0.0, np.radians(10.9), 1.0), ANGLE),
        ((0.2195, 0.3, 0.0, 0.0), TRACK),
        ((-0.2195, -0.3, 0.0, 0.0), TRACK),
        ((0.0, 0.0, 0.0, 0.0), LASTED),
    ],
)
def test_a_failure_has_its_cause(start, cause):
    plant = make_plant(iiwa(7), QUIET, 0.01)
    block = new_block()
    reset(plant, block, PENDULUM, start, 0)
    block.u[0] = 0.5
    step(plant, block, 1)
    assert CAUSES[block.cause[0]] == CAUSES[cause]


@pytest.mark.parametrize("row", range(4))
def test_a_joint_beyond_any_of_its_limits_is_reported(row):
    plant = make_plant(iiwa(7), QUIET, 0.01)
    block = new_block()
    reset(plant, block, PENDULUM, (0.0, 0.5, 0.0, 0.0), 0)
    limits = plant.limits.copy()
    limits[row] = {0: 3.0, 1: -3.0, 2: 1e-3, 3: 1e-3}[row]
    block.u[0] = 2.0
    step(plant._replace(limits=limits), block, 1)
    assert block.cause[0] == JOINT_LIMIT


def test_limits_are_reached_exactly_where_the_paper_puts_them():
    """|phi| = 11 degrees and |x| = 0.22 m are failures themselves."""
    plant = make_plant(iiwa(7), QUIET, 0.01)
    still = PendulumParameters(w2=0.0, k=0.0, c=0.0)
    block = new_block()
    for phi, cause in ((np.radians(11.0), ANGLE), (np.nextafter(np.radians(11.0), 0.0), LASTED)):
        reset(plant, block, still, (0.0, 0.0, phi, 0.0), 0)
        block.u[0] = 0.0
        step(plant, block, 1)
        assert block.state[PHI * LANES] == phi
        assert block.cause[0] == cause


def test_the_pendulum_feels_the_tracked_and_not_the_commanded_acceleration():
    plant = make_plant(iiwa(7), SETTINGS, 0.01)
    block = new_block()
    reset(plant, block, PENDULUM, (0.0, 0.0, 0.0, 0.0), 0)
    block.u[0] = 1.0
    block.noise[::LANES] = 3.0
    before = block.state[X_DOT * LANES]
    step(plant, block, 1)
    tracked = block.state[TRACKED * LANES]
    assert abs(tracked - 1.0) > 0.05  # three sigma of position noise times K_p is 0.12 m/s^2
    assert tracked == pytest.approx((block.state[X_DOT * LANES] - before) / 0.01, rel=1e-12)
    assert block.state[PHI * LANES] == pytest.approx(-7.15 * tracked * 0.01**2 / 2.0, rel=1e-2)


def test_noise_of_a_step_is_standard_normal_and_white():
    noise = np.zeros(6 * LANES)
    draws = []
    for tick in range(500):
        ticks, index = np.full(LANES, tick), np.arange(LANES)
        draw_noise(noise, 3, ticks, index, 0, TEST, LANES)
        draws.append(noise.copy())
    draws = np.array(draws)
    # 48,000 numbers: five standard errors, a chance of 6e-7 each.
    n = draws.size
    assert abs(draws.mean()) < 5.0 / np.sqrt(n)
    assert abs(draws.var() - 1.0) < 5.0 * np.sqrt(2.0 / n)
    assert abs(np.mean(draws[1:] * draws[:-1])) < 5.0 / np.sqrt(n)
    assert abs(np.mean(draws[:, :LANES] * draws[:, LANES : 2 * LANES])) < 5.0 / np.sqrt(n / 6)


def test_a_singular_home_is_refused():
    from equipoise.errors import ArmError

    arm = iiwa(7)
    home = list(arm.home)
    home[5] = 0.0
    with pytest.raises(ArmError, match="singular"):
        make_plant(arm.model_copy(update={"home": tuple(home)}), SETTINGS, 0.01)


def test_rows_of_the_state_are_those_of_the_paper():
    assert (X, X_DOT, PHI) == (0, 1, 2)
