"""The closed loop against integrators and kinematics that it does not use, and its symmetries."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equipoise import Estimate, PendulumParameters, evaluate, iiwa
from equipoise.control.linear import lqr_gains
from equipoise.control.policy import TABLE, KernelPolicy, PolicyKernel, shipped_policy
from equipoise.errors import ArmError
from equipoise.model import grid
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.grid import JOINT_LIMIT, TRUNCATED
from equipoise.model.pendulum import step as pendulum_step
from equipoise.settings import BoxSettings, Settings, changed, resolve
from equipoise.simulation.plant import DomainRandomization, make_loop_params, scaled
from tests.batch import NOMINAL, Batch
from tests.reference.closed_loop import Joints, Loop, pivot_velocity
from tests.simulation.recorded import on_the_plant, record

PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
SETTINGS = Settings()
STILL = resolve(overrides=["plant.inertia_sigma=0", "plant.friction_sigma=0"])
QUIET = resolve(overrides=["plant.position_error_sigma=0", "plant.orientation_error_sigma=0"])
BOXES = grid.make_grid(BoxSettings(look_ahead=0.0), 1.0)
ARMS = pytest.mark.parametrize("size", [7, 14])


def leaning_table():
    """Return a random table that leans towards the fall."""
    rng = np.random.default_rng(0)
    Q = rng.normal(size=(270, grid.ACTIONS))
    return KernelPolicy(PolicyKernel(TABLE, grid.greedy_accelerations(Q), boxes=BOXES))


@ARMS
@pytest.mark.parametrize(("x", "x_dot"), [(0.0, 0.0), (0.2, -0.6), (-0.13, 0.4)])
def test_reset_places_the_flange_on_its_track(size, x, x_dot):
    arm, lane = iiwa(size), 3
    start = (x, x_dot, 0.01, 0.02)
    block = Batch(make_loop_params(arm, QUIET, 0.01, PENDULUM, IDEAL_ACTUATOR))
    block.reset(PENDULUM, NOMINAL, start, lane)
    controller, home = block.controller, arm.kinematics(arm.home_free)
    now = arm.kinematics(controller.q[:, lane], controller.dq[:, lane])
    np.testing.assert_allclose(now.position - home.position, [x, 0.0, 0.0], atol=1e-11)
    np.testing.assert_allclose(now.rotation, home.rotation, atol=1e-11)
    np.testing.assert_allclose(now.twist, [x_dot, 0, 0, 0, 0, 0], atol=1e-11)
    np.testing.assert_allclose(block.true(lane), start, atol=1e-11)


@ARMS
def test_a_run_obeys_kinematics_and_the_pendulum_equation(size):
    """Every step again: joints by hand, flange by the arm's Python kinematics, phi by SciPy."""
    arm = iiwa(size)
    plant = make_loop_params(arm, SETTINGS, 0.01, PENDULUM, IDEAL_ACTUATOR)
    simulation = on_the_plant(plant, arm, PENDULUM, STILL, seed=1)
    trial = simulation.draw(1).trial(0)._replace(start=(0.01, -0.05, 0.02, 0.1))
    _, run = record(simulation, leaning_table(), trial, 0.6)
    assert len(run.u) > 15
    for i in range(len(run.u) - 1):
        before = arm.kinematics(run.q[i], run.dq[i])
        after = arm.kinematics(run.q[i + 1], run.dq[i + 1])
        tracked = (pivot_velocity(arm, after) - pivot_velocity(arm, before)) / 0.01
        assert run.tracked[i + 1] == pytest.approx(tracked, abs=1e-9)
        # Joint motion is that of a constant acceleration over the step.
        ddq = (run.dq[i + 1] - run.dq[i]) / 0.01
        moved = run.q[i] + 0.01 * run.dq[i] + 0.5 * ddq * 1e-4
        np.testing.assert_allclose(run.q[i + 1], moved, atol=1e-12)
        if i + 2 < len(run.u):
            phi, phi_dot = run.state[i + 1][2:]

            def falling(_, s, u=tracked):
                return s[1], 70.2 * np.sin(s[0]) - 0.15 * s[1] - 7.15 * u * np.cos(s[0])

            ode = solve_ivp(falling, (0.0, 0.01), [phi, phi_dot], rtol=1e-11, atol=1e-13)
            # 1e-7: a Runge-Kutta step of fourth order with w h = 0.084.
            np.testing.assert_allclose(run.state[i + 2][2:], ode.y[:, -1], atol=1e-7)
            flange = after.position[0] - arm.kinematics(arm.home_free).position[0]
            np.testing.assert_allclose(run.state[i + 2][:2], [flange, after.twist[0]], atol=1e-9)


@pytest.mark.parametrize("row", range(4))
def test_a_joint_beyond_any_of_its_limits_is_reported(row):
    plant = make_loop_params(iiwa(7), QUIET, 0.01, PENDULUM, IDEAL_ACTUATOR)
    block = Batch(plant)
    block.reset(PENDULUM, NOMINAL, (0.0, 0.5, 0.0, 0.0))
    limits = list(plant.controller.limits)
    limits[row] = ({0: 3.0, 1: -3.0, 2: 1e-3, 3: 1e-3}[row],) * 6
    block.controller.u[0] = 2.0
    block.plant = plant._replace(controller=plant.controller._replace(limits=tuple(limits)))
    block.step()
    assert block.state.cause[0] == JOINT_LIMIT


def test_a_singular_home_is_refused():
    arm = iiwa(7)
    home = list(arm.home)
    home[5] = 0.0
    away = arm.model_copy(update={"home": tuple(home)})
    with pytest.raises(ArmError, match="singular"):
        make_loop_params(away, SETTINGS, 0.01, PENDULUM, IDEAL_ACTUATOR)


# Behind an actuator

FINE = f"plant.counts_per_rev={2**40}"
GAINS = np.array(lqr_gains(PENDULUM, 0.01))
KST = Actuator.assumed("kst", delay=0.010, lag=0.008)


def differing(kind, delay, *lags):
    """Return an actuator whose joints differ."""
    lags = tuple(Estimate.around(lag, 0.0, "given") for lag in lags)
    return Actuator.assumed(kind, delay=delay).model_copy(update={"lags": lags})


@pytest.mark.parametrize(
    ("actuator", "variation", "overrides"),
    [
        (KST, DomainRandomization(1.03, 1.3, 0.003, 1.2, 0.005), []),
        (
            differing("lag", 0.006, 0.03, 0.02, 0.025, 0.015, 0.02, 0.03),
            DomainRandomization(0.98, 1.0, -0.006, 1.0, 0.0),
            ["controller.predict=false", "plant.linearised=true"],
        ),
        # As long as it remembers, and what may come on top.
        (
            Actuator.assumed("kst", delay=0.09, lag=0.004),
            DomainRandomization(1.0, 1.0, 0.008, 1.0, 0.0),
            [],
        ),
    ],
)
def test_a_step_behind_an_actuator_is_that_of_the_slow_loop(actuator, variation, overrides):
    arm, pendulum = iiwa(7), PENDULUM._replace(drag=0.01)
    settings = resolve(overrides=[*overrides, FINE])
    pendulum = pendulum._replace(linearised=settings.plant.linearised)
    plant = make_loop_params(arm, settings, 0.01, pendulum, actuator)
    block = Batch(plant)
    x, phi, phi_dot = 0.03, 0.015, 0.1
    lane = 5
    block.reset(pendulum, variation, (x, 0.0, phi, phi_dot), lane)
    own = scaled(pendulum, variation)
    differs = {"delay": variation.delay, "factor": variation.lag_factor}
    horizon = plant.controller.horizon
    slow = Loop(arm, settings, actuator, pendulum, own, horizon=horizon, **differs)
    slow.begin(block.controller.q[:, lane], x, phi, phi_dot, variation.zero)
    sigma = np.repeat((1e-4, np.radians(0.02)), 3)
    rng = np.random.default_rng(0)
    for _ in range(150):
        # Each is balanced by what it sees itself, or a last bit would grow with the fall.
        push = 0.5 * rng.choice([-1, 0, 1])
        noise = rng.standard_normal(6)
        block.controller.noise[:, lane] = noise
        block.controller.u[lane] = np.clip(GAINS @ block.observation(lane), -3.0, 3.0) + push
        block.step(lane + 1)
        slow.step(np.clip(GAINS @ slow.seen, -3.0, 3.0) + push, sigma * noise)
        # Between two counts of 6e-12 rad nothing holds the two together.
        np.testing.assert_allclose(block.controller.q[:, lane], slow.q, atol=1e-9)
        np.testing.assert_allclose(block.state.arm.q[:, lane], slow.joints.q, atol=1e-9)
        np.testing.assert_allclose(block.true(lane), slow.state, atol=1e-9)
        np.testing.assert_allclose(block.observation(lane), slow.seen, atol=2e-9)
        np.testing.assert_allclose(block.estimate(lane)[:3], slow.estimate, atol=2e-9)
    assert abs(slow.state[2]) < np.radians(11)  # it stood for all of the 1.5 s


def test_a_wrong_zero_does_not_decide_about_a_failure():
    # The policy sees a pendulum at 11.2 degrees; it leans by 10.5.
    plant = make_loop_params(iiwa(7), QUIET, 0.01, PENDULUM, KST)
    block = Batch(plant)
    variation = NOMINAL._replace(zero=np.radians(0.7))
    block.reset(PENDULUM, variation, (0.0, 0.0, np.radians(10.5), 0.0))
    block.step()
    assert block.controller.observation.phi[0] > np.radians(11)
    assert block.state.cause[0] == TRUNCATED


def test_behind_an_actuator_a_pendulum_with_dry_friction_feels_the_pivot_as_it_moves():
    """Each tick again, millisecond by millisecond: the setpoints make the velocity a ripple."""
    arm, pendulum = iiwa(14), PENDULUM._replace(coulomb=1.0)
    plant = make_loop_params(arm, SETTINGS, 0.01, PENDULUM, KST)
    block = Batch(plant)
    block.reset(pendulum, NOMINAL, (0.0, 0.0, 0.03, 0.0))
    joints, rng = Joints(KST, 1.0, arm.home_free), np.random.default_rng(0)
    setpoints, v = [arm.home_free] * 2, 0.0
    for _ in range(150):
        before = block.true(0)
        block.controller.noise[:] = rng.standard_normal((6, 16))
        block.controller.u[0] = np.clip(GAINS @ block.observation(0), -2.0, 2.0)
        block.step()
        # 10 ms after they were sent.
        in_force, setpoints = setpoints, block.controller.setpoints[:, :, 0].copy()
        phi, phi_dot = before[2:]
        for ms in range(10):
            joints.millisecond(in_force[ms // 5])
            v_before, v = v, pivot_velocity(arm, arm.kinematics(joints.q, joints.dq))
            phi, phi_dot = pendulum_step(phi, phi_dot, (v - v_before) / 1e-3, 1e-3, pendulum)
        assert block.true(0)[2:] == pytest.approx((phi, phi_dot), abs=1e-9)
    np.testing.assert_allclose(joints.q, block.state.arm.q[:, 0], atol=1e-12)


def test_a_policy_balances_behind_a_fast_lag_that_moves_in_steps():
    policy, actuator = shipped_policy(), Actuator.assumed("lag", delay=0.006, lag=0.002)
    settings = changed(policy.settings, {"evaluation.trials": 24, "evaluation.duration": 20.0})
    found = evaluate(policy, settings, actuator=actuator, with_baselines=False, workers=2)
    assert min(found.results.survival) == 20.0
