"""The controller: how far it looks ahead, what it makes of measurements, and whether that is true.

That all of it together equals a slow loop is shown in tests/simulation/test_plant.py.
"""

from math import pi

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equipoise import Actuator, Estimate, PendulumParameters, iiwa, resolve
from equipoise.arrays import fields, first_lane, new_records
from equipoise.control.control_step import ControllerState, horizon, make_controller_params
from equipoise.control.controller import call_alone, observe_tick, start
from equipoise.control.linear import lqr_gains
from equipoise.control.policy import Observation
from equipoise.elementary import BATCH_SIZE
from equipoise.errors import SettingsError
from equipoise.model.grid import TRUNCATED
from equipoise.simulation.plant import make_loop_params
from tests.batch import NOMINAL, Batch
from tests.reference.closed_loop import Joints

ARM = iiwa(14)
H = 0.01
PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
FINE = 2**40
"""Counts of an encoder whose steps do not matter."""
QUIET = ["plant.position_error_sigma=0", "plant.orientation_error_sigma=0"]


def made(actuator, *overrides, counts=8192, h=H):
    settings = resolve(overrides=overrides)
    return make_controller_params(ARM, settings, actuator, PENDULUM, h=h, counts_per_rev=counts)


# How far it looks ahead


@pytest.mark.parametrize(("high", "delay"), [(0.010, 0.015), (0.019, 0.019)])
def test_the_horizon_is_the_delay_with_its_upper_end_or_the_margin_and_the_lag(high, delay):
    found = Estimate(value=0.010, low=0.002, high=high, source="identified")
    actuator = Actuator.assumed("lag", lag=0.008).model_copy(update={"delay": found})
    # Whichever is more: 10 ms and a margin of 5 ms, or the upper end of the interval.
    assert horizon(ARM, actuator, 0.005) == pytest.approx(delay + 0.008, abs=1e-12)


def test_the_lags_of_the_joints_count_by_what_they_do_to_the_flange():
    lags = (0.004, 0.030, 0.010, 0.002, 0.020, 0.007)
    found = tuple(Estimate.around(lag, 0.0, "identified") for lag in lags)
    actuator = Actuator.assumed("lag", delay=0.0).model_copy(update={"lags": found})
    # The arm moves along x and each joint stays behind by its lag: so far is the flange behind.
    home = ARM.kinematics(ARM.home_free)
    x_dot = 1e-3
    dq = np.linalg.solve(home.jacobian, [x_dot, 0, 0, 0, 0, 0])
    behind = home.position - ARM.kinematics(ARM.home_free - dq * lags).position
    assert horizon(ARM, actuator, 0.0) == pytest.approx(behind[0] / x_dot, rel=1e-4)


def test_a_delay_that_is_longer_than_the_memory_is_refused():
    made(Actuator.assumed("kst", delay=0.090, lag=0.008))
    with pytest.raises(SettingsError, match=r"delay is 91 ms, expected at most 90 ms, "):
        made(Actuator.assumed("kst", delay=0.091, lag=0.008))
    with pytest.raises(SettingsError, match="at most 45 ms"):
        made(Actuator.assumed("lag", delay=0.050), h=0.005)


# What it makes of measurements


def swinging(age, revolutions, counts=FINE, ticks=300):
    """Let the pendulum hang and swing below an arm at rest; return estimates and truth.

    The counts are so old and so many revolutions off.
    """
    times = H * np.arange(ticks + 1)
    swing = solve_ivp(
        lambda _, s: [s[1], 70.2 * np.sin(s[0]) - 0.15 * s[1]], (0.0, times[-1]), [pi - 0.6, 0.0],
        rtol=1e-10, atol=1e-12, dense_output=True,
    ).sol  # fmt: skip
    controller = made(Actuator.assumed("lag", delay=0.01, lag=0.008), counts=counts)
    records = new_records(ControllerState)
    memory = fields(records, ControllerState)
    start(controller, records, Observation(0.0, 0.0, *swing(0.0)))
    memory.measured[:, 0] = ARM.home_free
    estimates = []
    for time in times[1:]:
        memory.u[0] = 0.0
        call_alone(controller.command, controller, records)
        theta = pi - swing(time - age)[0] + 2.0 * pi * revolutions
        memory.counts[0] = np.floor(theta * counts / (2.0 * pi) + 0.5)
        observe_tick(controller, records, (age, 0.0))
        estimates.append(first_lane(memory.estimate)[:3])
    return np.array(estimates), swing(times[1:]).T


@pytest.mark.parametrize(("age", "revolutions"), [(0.001, 0), (0.003, -2), (0.008, 3)])
def test_old_counts_are_taken_from_their_own_time_and_whole_revolutions_do_not_matter(
    age, revolutions
):
    estimates, truth = swinging(age, revolutions)
    difference = estimates[:, 0] - truth[:, 0]
    error = np.abs(difference - 2.0 * pi * np.round(difference / (2.0 * pi))).max()
    fastest, hardest = np.abs(truth[:, 1]).max(), 70.2 * np.sin(0.6)
    # A straight line back: what is left is of second order, beside the first-order age * phi_dot.
    assert error < age**2 * hardest
    assert error < 0.1 * age * fastest


def offsets_of(reply_age, actuator, believed_age):
    """Accelerate an arm that follows as the actuator says; return what corrects its model."""
    controller = made(actuator, "controller.predict=false")
    records = new_records(ControllerState)
    memory = fields(records, ControllerState)
    start(controller, records, Observation(0.0, 0.0, 0.0, 0.0))
    arm = Joints(actuator, 1.0, ARM.home_free)
    went, sent = [arm.q.copy()] * 50, [(-1000, ARM.home_free)]
    transport = round(1e3 * actuator.delay.value)
    offsets = []
    for tick in range(60):
        memory.u[0] = 1.0 if tick < 20 else 0.0
        call_alone(controller.command, controller, records)
        setpoints = memory.setpoints[:, :, 0].copy()
        sent += [(10 * tick, setpoints[0]), (10 * tick + 5, setpoints[1])]
        for ms in range(10 * tick, 10 * tick + 10):
            arm.millisecond([q for time, q in sent if time + transport <= ms][-1])
            went.append(arm.q.copy())
        memory.measured[:, 0] = went[-1 - round(1e3 * reply_age)]
        observe_tick(controller, records, (0.0, believed_age))
        offsets.append(memory.offset[:, 0].copy())
    return np.array(offsets)


@pytest.mark.parametrize(("delay", "reply_age"), [(0.0, 0.016), (0.013, 0.0), (0.013, 0.010)])
def test_measured_joints_are_compared_with_the_model_of_their_own_time(delay, reply_age):
    actuator = Actuator.assumed("kst", delay=delay, lag=0.008)
    # The model is right, so there is nothing to correct; 5e-5 rad is a ripple between two ticks.
    assert np.abs(offsets_of(reply_age, actuator, reply_age)).max() < 5e-5
    # 10 ms at 0.2 m/s, which is some 0.2 rad/s of a joint.
    assert np.abs(offsets_of(reply_age, actuator, reply_age + 0.01)).max() > 5e-4


# Whether that is true: on the plant, balanced by a linear policy on what the policy sees


def balance(actuator, *overrides, ticks, push):
    """Yield plant and block of 16 trials, before each tick; all of them must last."""
    settings = resolve(overrides=overrides)
    plant = make_loop_params(ARM, settings, H, PENDULUM, actuator)
    block, rng = Batch(plant), np.random.default_rng(0)
    gains = np.array(lqr_gains(PENDULUM, H))
    for n in range(BATCH_SIZE):
        block.reset(PENDULUM, NOMINAL, (0.0, 0.0, rng.uniform(-0.03, 0.03), 0.0), n)
    for _ in range(ticks):
        yield plant, block
        u = gains @ block.observation() + push * rng.choice([-1, 0, 1], BATCH_SIZE)
        block.controller.u[:] = np.clip(u, -2.0, 2.0)
        block.controller.noise[:] = rng.standard_normal((6, BATCH_SIZE))
        block.step(BATCH_SIZE)
        assert np.all(block.state.cause == TRUNCATED)


def rms(values, axis=None):
    return np.sqrt(np.mean(np.square(values), axis=axis))


def later(plant, block, ticks):
    """Return the state of a block after some ticks without acceleration, shape (4, lanes)."""
    block = Batch(plant, block.records)
    for _ in range(ticks):
        block.controller.u[:] = block.controller.noise[:] = 0.0
        block.step(BATCH_SIZE)
    return block.true()


@pytest.mark.compiled_only
@pytest.mark.parametrize(
    ("kind", "horizon", "lag"), [("kst", 0.04, 0.008), ("kst", 0.06, 0.012), ("lag", 0.04, 0.02)]
)
def test_what_the_policy_sees_is_the_state_at_the_horizon(kind, horizon, lag):
    """On a plant that is as the controller thinks, the state T later if u is 0 from now on."""
    follows = Actuator.assumed(kind, lag=lag).response_time(0)
    actuator = Actuator.assumed(kind, delay=horizon - follows, lag=lag)
    overrides = [*QUIET, f"plant.counts_per_rev={FINE}", "controller.margin=0"]
    errors, changes = [], []
    run = balance(actuator, *overrides, ticks=240, push=0.5)
    for tick, (plant, block) in enumerate(run):
        if tick >= 40 and tick % 10 == 0:
            assert plant.controller.horizon == pytest.approx(horizon, abs=1e-12)
            then = later(plant, block, round(horizon / H))
            errors.append(block.observation() - then)
            changes.append(block.true() - then)
    x, x_dot, phi, phi_dot = rms(errors, axis=(0, 2))
    # Beside a track of 0.22 m and angles of 11 degrees; what is left of the velocities is the
    # ripple of setpoints that come 200 times a second.
    assert x < 5e-4
    assert x_dot < 0.006
    assert phi < np.radians(0.03)
    assert phi_dot < np.radians(2.0)
    # Until then the pendulum moves much further than the prediction is wrong.
    assert phi < 0.3 * rms(changes, axis=(0, 2))[2]
