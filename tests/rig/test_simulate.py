"""A simulated run and its log; `tests/worlds/test_plant.py` recomputes the motion of its plant."""

import numpy as np
import pytest

from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.rig.simulate import DEPLOYMENT, simulate_run
from equipoise.worlds.plant import make_loop_params
from tests.worlds.recorded import on_the_plant, run_all


@pytest.fixture(scope="module")
def run(small_policy):
    return simulate_run(small_policy, seed=5, duration=0.6)


def test_equal_seed_gives_equal_bits_and_another_seed_another_run(run, small_policy):
    assert simulate_run(small_policy, seed=5, duration=0.6).digest == run.digest
    other = simulate_run(small_policy, seed=6, duration=0.6)
    assert other.conditions.start != run.conditions.start
    assert other.conditions.pendulum != run.conditions.pendulum


def test_it_starts_as_a_release_leaves_the_pendulum(run):
    x, x_dot, phi, phi_dot = run.conditions.start
    assert (x, x_dot) == (0.0, 0.0)
    assert 1.5 <= np.rad2deg(abs(phi)) <= 2.5
    assert 8.0 <= np.rad2deg(abs(phi_dot)) <= 18.0
    assert phi * phi_dot > 0.0
    # Home is found to the tolerance of the posture's iteration, 1e-12.
    first = (run.x[0], run.x_dot[0], run.phi[0], run.phi_dot[0])
    np.testing.assert_allclose(first, run.conditions.start, atol=1e-9)


def test_what_the_policy_saw_is_the_truth_of_the_arm(run, small_policy):
    for name in ("x", "x_dot", "phi", "phi_dot"):
        np.testing.assert_array_equal(getattr(run.truth, name), getattr(run, name))
    np.testing.assert_array_equal(run.estimated_phi, run.phi)
    np.testing.assert_array_equal(run.bias, 0.0)
    arm = small_policy.arm
    home = arm.kinematics(arm.home_free).position[0]
    flange = [arm.kinematics(arm.without_held(q)).position[0] for q in run.truth.q]
    np.testing.assert_allclose(np.array(flange) - home, run.truth.x, atol=1e-12)


def test_it_is_the_trial_that_the_compiled_loop_runs(small_policy):
    settings = small_policy.settings
    long = simulate_run(small_policy, seed=5, duration=20.0)
    pendulum = small_policy.pendulum.parameters()
    params = make_loop_params(small_policy.arm, settings, small_policy.h, pendulum)
    simulation = on_the_plant(params, small_policy.arm, pendulum, settings, 5, DEPLOYMENT)
    trial = run_all(simulation, small_policy.kernel, simulation.draw(1), 20.0)
    assert len(long.time) == trial.steps[0]
    assert long.outcome == TRIAL_OUTCOMES[trial.cause[0]]
    # Small steps end runs early: x^2 before each step, against the sum after each step.
    assert np.sum(long.x[1:] ** 2) == pytest.approx(trial.sum_x2[0], rel=0.1)
