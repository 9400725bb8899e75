"""A simulated run and its log; `tests/simulation/test_plant.py` recomputes its plant's motion."""

import numpy as np
import pytest

from equipoise.model.actuator import IDEAL_ACTUATOR
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.rig.simulate import DEPLOYMENT, simulate_run
from equipoise.simulation.plant import make_loop_params
from tests.simulation.recorded import on_the_plant, run_all


def test_it_is_the_trial_that_the_compiled_loop_runs(small_policy):
    settings = small_policy.settings
    long = simulate_run(small_policy, seed=5, duration=20.0)
    pendulum = small_policy.pendulum.parameters()
    params = make_loop_params(small_policy.arm, settings, small_policy.h, pendulum, IDEAL_ACTUATOR)
    simulation = on_the_plant(params, small_policy.arm, pendulum, settings, 5, DEPLOYMENT)
    trial = run_all(simulation, small_policy.kernel, simulation.draw(1), 20.0)
    assert len(long.time) == trial.steps[0]
    assert long.outcome == TRIAL_OUTCOMES[trial.cause[0]]
    # x^2 before each step, against the sum after each step.
    assert np.sum(long.ticks.x[1:] ** 2) == pytest.approx(trial.sum_x2[0], rel=0.1)
