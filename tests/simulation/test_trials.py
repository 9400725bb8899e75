"""Trials: what is drawn for them, and that neither lanes, pieces nor workers change a bit."""

from math import inf, nextafter, radians, sqrt

import numpy as np
import pytest
from scipy import stats

from equipoise import PendulumParameters, iiwa, paper, resolve
from equipoise.control.policy import RANDOM, Observation, PolicyKernel
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.grid import ANGLE, TRACK, TRUNCATED
from equipoise.model.random import SELECTION, TARGET_TEST, TEST
from equipoise.outcomes import TRIAL_OUTCOMES, Outcome
from equipoise.simulation.plant import DomainRandomization, failure, make_loop_params, scaled
from equipoise.simulation.trials import Trials, draw_trials
from tests.batch import NOMINAL, Batch
from tests.simulation.recorded import on_the_plant, run_all

ARM = iiwa(14)
PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
SETTINGS = resolve()
CONDITIONS = ("start", "variation")
STREAMS = (SELECTION, TARGET_TEST, TEST)


@pytest.fixture(scope="module")
def plant():
    return make_loop_params(ARM, SETTINGS, paper.STEP, PENDULUM, IDEAL_ACTUATOR)


def drawn(count=100, seed=0, stream=TEST, settings=SETTINGS):
    return draw_trials(count, settings, seed, stream)


def taken(trials, rows):
    return Trials._make(column[rows] for column in trials)


def outcome(trials):
    """Return the bits of what came of trials."""
    return [column.tobytes() for column in (trials.steps, trials.cause, trials.sum_x2, trials.end)]


# What is drawn


def test_the_conditions_of_a_trial_do_not_depend_on_how_many_there_are():
    few, many = drawn(7), drawn(1000)
    for name in ("number", *CONDITIONS):
        assert getattr(few, name).tobytes() == getattr(many, name)[:7].tobytes()
        later = draw_trials(63, SETTINGS, 0, TEST, first=937)
        assert getattr(later, name).tobytes() == getattr(many, name)[937:].tobytes()


def test_conditions_have_their_distributions():
    overrides = ["plant.delay_spread=0.003", "plant.lag_spread=0.3", "plant.zero_error=0.004"]
    trials = drawn(5000, settings=resolve(overrides=overrides))
    assert not trials.start[:, :2].any()  # x = x_dot = 0
    phi, phi_dot = trials.start[:, 2:].T
    assert np.array_equal(np.sign(phi), np.sign(phi_dot))
    assert stats.binomtest(int(np.sum(phi > 0)), 5000).pvalue > 1e-5
    varied = DomainRandomization(*trials.variation.T)
    inertia = stats.norm.cdf((varied.inertia_factor - 1.0) / 0.02)
    friction = stats.norm.cdf((varied.friction_factor - 1.0) / 0.2)
    columns = (
        (np.abs(phi), radians(1.5), radians(2.5)),
        (np.abs(phi_dot), radians(8.0), radians(18.0)),
        (inertia, 0.0, 1.0),
        (friction, 0.0, 1.0),
        (varied.delay, -0.003, 0.003),
        (varied.lag_factor, 1.0 - 0.3, 1.0 + 0.3),
        (varied.zero, -0.004, 0.004),
    )
    for values, low, high in columns:
        # Below 1e-5 for one new seed in 10,000.
        assert stats.kstest((values - low) / (high - low), "uniform").pvalue > 1e-5
    correlations = np.corrcoef([values for values, _, _ in columns])
    assert np.abs(correlations[np.triu_indices(len(columns), 1)]).max() < 5 / sqrt(5000)


@pytest.mark.parametrize("seed", [0, 1, 2**40, 2**63 - 1])
def test_selection_target_test_and_evaluation_share_no_trial(seed):
    rounds = [drawn(50, s, t) for s in (seed, seed - 1) if s >= 0 for t in STREAMS]
    for name in CONDITIONS:
        numbers = np.concatenate([getattr(trials, name).ravel() for trials in rounds])
        numbers = numbers[numbers != 0.0]  # x and x_dot
        assert len(np.unique(numbers)) == len(numbers)


def varied(pendulum, inertia, friction):
    return scaled(pendulum, NOMINAL._replace(inertia_factor=inertia, friction_factor=friction))


def test_factors_on_inertia_divide_everything_and_factors_on_friction_only_c():
    pendulum = PendulumParameters(70.0, 7.0, 0.2, 0.3, 0.4, True)
    assert varied(pendulum, 2.0, 3.0) == pytest.approx((35.0, 3.5, 0.3, 0.15, 0.2, True))
    # b = c I stays when I alone changes; m g l = w2 I always.
    heavier = varied(pendulum, 1.25, 1.0)
    assert heavier.c * 1.25 == pytest.approx(pendulum.c)
    assert heavier.w2 * 1.25 == pytest.approx(pendulum.w2)
    # Noise makes no pendulum without inertia, and none that friction drives.
    extreme = varied(pendulum, -0.2, -0.5)
    assert (extreme.w2, extreme.c) == (pytest.approx(700.0), 0.0)


# Lanes, pieces and workers


@pytest.mark.parametrize("kind", ["ideal", "lag", "kst"])
def test_a_trial_gives_the_same_bits_alone_as_in_company(kind):
    behind = {} if kind == "ideal" else {"delay": 0.0125, "lag": 0.015}
    actuator = Actuator.assumed(kind, **behind)
    plant = make_loop_params(ARM, SETTINGS, paper.STEP, PENDULUM, actuator)
    together, longest = drawn(40), 60
    simulation = on_the_plant(plant, ARM, PENDULUM, seed=5)
    loop, policy = simulation.loop(), PolicyKernel(RANDOM)
    world = loop.prepare(simulation.draw(1).trial(0))
    run_trials = loop.KERNELS.run_trials
    run_trials(world, policy, together, longest)
    alone = [taken(drawn(40), [i]) for i in range(40)]
    for trial in alone:
        run_trials(world, policy, trial, longest)
    assert [outcome(trial) for trial in alone] == [outcome(taken(together, [i])) for i in range(40)]
    world.rows[:] = 7  # the states of a batch before its trials do not matter
    for rows in (np.arange(39, 2, -1), np.arange(3)):
        backwards = taken(drawn(40), rows)
        run_trials(world, policy, backwards, longest)
        assert outcome(backwards) == outcome(taken(together, rows))


@pytest.mark.parametrize("count", [1, 17, 65])
def test_every_trial_is_run_once_and_told_of(plant, count):
    finished = []
    simulation = on_the_plant(plant, ARM, PENDULUM, SETTINGS)
    drawn_trials = simulation.draw(count)
    trials = run_all(simulation, PolicyKernel(RANDOM), drawn_trials, 0.1, done=finished.append)
    assert sum(finished) == count
    assert np.all(trials.steps > 0)


# Failure


def placed(plant, phi=0.0, x=0.0, x_dot=0.0):
    """Return x, x_dot and cause of the end after a step of a pendulum on which nothing acts."""
    block = Batch(plant)
    block.reset(PendulumParameters(0.0, 0.0, 0.0), NOMINAL, (x, x_dot, phi, 0.0))
    block.step()
    return *map(abs, block.true(0)[:2].tolist()), TRIAL_OUTCOMES[int(block.state.cause[0])]


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_limit_is_a_failure_and_what_is_just_within_is_not(plant, sign):
    eleven = sign * np.radians(11.0)
    assert placed(plant, phi=eleven)[2] == "angle"
    assert placed(plant, phi=nextafter(eleven, 0.0))[2] == "survived"
    _, x_dot, outcome = placed(plant, x=sign * 0.1, x_dot=sign * 0.2)
    assert (plant.max_speed, outcome) == (inf, "survived")
    for max_speed, expected in ((x_dot, Outcome.SPEED), (nextafter(x_dot, inf), "survived")):
        strict = plant._replace(max_speed=max_speed)
        assert placed(strict, x=sign * 0.1, x_dot=sign * 0.2)[2] == expected
    end, upright = sign * 0.22, Observation(0.0, 0.0, 0.0, 0.0)
    assert failure(upright._replace(x=end), False, inf, True) == TRACK
    assert failure(upright._replace(x=nextafter(end, 0.0)), False, inf, True) == TRUNCATED
    assert failure(upright._replace(phi=eleven), False, inf, True) == ANGLE
    assert failure(upright._replace(phi=sign * 3.0), False, inf, False) == TRUNCATED


def test_an_angle_is_told_before_the_track_the_track_before_a_joint_and_that_before_a_speed(plant):
    lower, *others = plant.controller.limits
    limits = (tuple(q + 10.0 for q in lower), *others)
    slow = plant._replace(max_speed=0.1)
    strict = slow._replace(controller=plant.controller._replace(limits=limits))
    assert placed(strict, phi=0.3, x=0.23, x_dot=0.2)[2] == "angle"
    assert placed(strict, phi=float("nan"))[2] == "angle"
    assert placed(strict, x=0.23, x_dot=0.2)[2] == "track"
    assert placed(strict, x_dot=0.2)[2] == "joint limit"
    assert placed(slow, x_dot=0.2)[2] == Outcome.SPEED
