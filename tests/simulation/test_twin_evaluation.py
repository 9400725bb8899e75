"""Evaluation and deployment on the twin: equal trials for all."""

import numpy as np
import pytest

from equipoise import Pendulum, evaluate, excite, iiwa, simulate_run, train
from equipoise.model.worlds import TwinSettings, World
from equipoise.outcomes import Outcome
from equipoise.settings import changed
from tests.model.test_worlds import COULOMB, FRICTION

WORLD = "twin:nominal"
UNGUARDED = World("twin:unguarded", TwinSettings(guards=False))


@pytest.fixture(scope="module")
def behind_a_servo(pendulum, quick_settings):
    """A policy that has hardly been trained, behind the shipped actuator."""
    return train(pendulum, iiwa(7), quick_settings, seed=3)


def test_a_run_on_the_twin_holds_what_was_sent_measured_and_true(behind_a_servo):
    run = simulate_run(behind_a_servo, world=WORLD, seed=1, duration=1.0)
    n = len(run.time)
    assert run.outcome in Outcome
    assert len(run.stream.time) == 2 * n
    assert len(run.replies.time) == len(run.encoder.time) == len(run.truth.x) == n
    assert np.allclose(np.diff(run.stream.time), 0.005)
    # The encoder shows the truth, but for its zero, its step and its age.
    step = 2.0 * np.pi / run.conditions.counts_per_rev
    shown = np.pi - run.encoder.counts * step - run.conditions.zero_error
    error = shown - run.truth.phi + (run.time - run.encoder.time) * run.truth.phi_dot
    assert np.abs(error).max() < step + 0.003  # the flange's rotation about the spindle
    # The second setpoint of a tick is the commanded posture at its end.
    assert np.array_equal(run.stream.q[1::2], run.ticks.q)


def test_the_twin_has_the_friction_that_was_identified(behind_a_servo):
    dry = behind_a_servo.pendulum.model_copy(update=FRICTION)
    policy = behind_a_servo.model_copy(update={"pendulum": dry})
    sticky = World("twin:sticky", TwinSettings(coulomb=0.1, drag=0.0))
    for world, coulomb, drag, varies in ((WORLD, 1.957, 0.02, True), (sticky, 0.1, 0.0, False)):
        run = simulate_run(policy, world=world, seed=1, duration=0.2).conditions
        inertia = run.pendulum.w2 / dry.w2.value if varies else 1.0
        assert run.pendulum.coulomb == pytest.approx(coulomb * inertia)
        assert run.pendulum.drag == pytest.approx(drag * inertia)
        excited = excite(iiwa(7), world, dry, duration=0.2).conditions
        assert excited.pendulum.coulomb == coulomb


def test_model_and_twin_agree_about_a_regulator_on_a_pivot_with_dry_friction(behind_a_servo):
    """The vibration of the pivot within a tick breaks the hold of dry friction, on both."""
    dry = Pendulum.assumed(120.26, 0.234).model_copy(update={"coulomb": COULOMB})
    policy = behind_a_servo.model_copy(update={"pendulum": dry})
    settings = changed(policy.settings, {"evaluation.trials": 6, "evaluation.duration": 12.0})
    for world in ("model", WORLD):
        told = evaluate(policy, settings, world=world)
        lqr = next(results for results in told.baselines if results.name == "LQR")
        assert lqr.summary().survived == 6


def test_what_a_policy_was_trained_for_limits_its_speed_on_plant_and_twin(behind_a_servo):
    slow = changed(behind_a_servo.settings, {"plant.max_speed": 0.02})
    policy = behind_a_servo.model_copy(update={"settings": slow})
    for world in ("model", WORLD):
        results = evaluate(policy, world=world, seed=4, with_baselines=False).results
        assert set(results.outcomes) == {"flange speed"}
        run = simulate_run(policy, world=world, seed=4, duration=2.0)
        assert run.outcome == "flange speed"
        assert abs(run.truth.x_dot).max() < 0.1
    # A world without guards has none.
    free = evaluate(policy, world=UNGUARDED, seed=4, with_baselines=False).results
    assert "flange speed" not in free.outcomes
