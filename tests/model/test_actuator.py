"""The actuator's kernels: against the server's own table, closed forms and a slow loop."""

from math import expm1, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from equipoise.arrays import new_records
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import compilable, kernel
from equipoise.model.actuator import (
    AMPLITUDE,
    CYCLE,
    IDEAL,
    INTERVAL_WIDTH,
    KST,
    LAG,
    NEAR,
    UNSHAPED,
    Actuator,
    ActuatorParameters,
    JointResponse,
    Servos,
    follow,
    follow_setpoint,
    lag_fraction,
    shaped_step,
    steady_error,
    track,
)

compiled = compilable(follow_setpoint)

SHAPED = ActuatorParameters(KST)
UNSHAPED_SERVO = ActuatorParameters(UNSHAPED, cycle=0.02)


@kernel
def follow_cycles(servos, actuator, cycles, lanes):
    compiled(servos[0], actuator, cycles, False, lanes)


@kernel
def cycle(servos, actuator, lanes):
    follow(servos[0], actuator, 0, lanes)


def servos(q, dq, target, fraction):
    """Return servos with the same numbers, or blocks of them."""
    records = new_records(Servos)
    for name, value in (("q", q), ("dq", dq), ("target", target), ("fraction", fraction)):
        records[name] = value
    return records


def moved(targets, actuator, lag=0.0):
    """Return positions and velocities of a joint after each cycle, from rest at zero."""
    joint = servos(0.0, 0.0, 0.0, lag_fraction(lag))
    positions, velocities = [], []
    for target in targets:
        joint["target"] = target
        cycle(joint, actuator, 1)
        positions.append(joint["q"][0, 0, 0])
        velocities.append(joint["dq"][0, 0, 0])
    return np.array(positions), np.array(velocities)


# The shaping law.


@given(st.floats(-3.0, 3.0) | st.floats(-NEAR * INTERVAL_WIDTH, NEAR * INTERVAL_WIDTH))
def test_the_shaping_law_is_the_servers_formula(e):
    # In the server's source: sign(e) 0.07 (1 - exp(-(e / 0.0525)^2)).
    expected = np.sign(e) * 0.07 * -expm1(-((e / 0.0525) ** 2))
    found = shaped_step(e, AMPLITUDE, INTERVAL_WIDTH)
    assert found == pytest.approx(expected, rel=1e-11, abs=1e-300)


STEADY_LAG_MS = {
    # Speed [rad/s]: lag [ms] with a cycle of 1, 2 and 4 ms, and a perfect drive.
    0.05: (28.0, 40.0, 56.0),
    0.10: (20.0, 28.0, 40.0),
    0.25: (12.6, 18.0, 25.0),
    0.50: (8.9, 12.6, 18.0),
    1.00: (6.3, 8.9, 12.7),
}


@pytest.mark.parametrize("speed", STEADY_LAG_MS)
@pytest.mark.parametrize("cycle", [1, 2, 4])
def test_the_steady_lag_is_the_table_of_the_servo(speed, cycle):
    expected = STEADY_LAG_MS[speed][(1, 2, 4).index(cycle)]
    actuator = ActuatorParameters(KST, cycle=cycle * CYCLE)
    lag_ms = 1e3 * steady_error(speed, 0.008, actuator) / speed
    # The table gives two digits.
    assert lag_ms == pytest.approx(expected, rel=0.02)
    assert steady_error(-speed, 0.008, actuator) == -steady_error(speed, 0.008, actuator)


@pytest.mark.parametrize("lag", [0.0, 0.016])
@pytest.mark.parametrize("servo", [SHAPED, UNSHAPED_SERVO])
def test_a_ramp_is_followed_at_the_steady_error(servo, lag):
    times, speed = np.arange(1500) * CYCLE, 0.25
    q, dq = moved(speed * times, servo, lag)
    # The error that the next cycle sees.
    e = speed * (times[-1] + CYCLE) - q[-1]
    assert e == pytest.approx(steady_error(speed, lag, servo), rel=1e-6)
    assert dq[-1] == pytest.approx(speed, rel=1e-6)


@pytest.mark.parametrize(("step", "expected_ms"), [(1e-3, 353), (10e-3, 34), (100e-3, 3)])
def test_a_step_takes_as_long_to_nine_tenths_as_the_table_says(step, expected_ms):
    q, _ = moved(np.full(1000, step), SHAPED)
    assert int(np.argmax(q >= 0.9 * step)) + 1 == pytest.approx(expected_ms, abs=1)


@pytest.mark.parametrize("servo", [SHAPED, UNSHAPED_SERVO])
def test_behind_a_lag_the_servo_is_the_differential_equation_of_the_docstring(servo):
    lag, target = 0.016, 0.005

    def slope(t, y):
        e = target - y[0]
        wanted = np.sign(e) * 0.07 / 1e-3 * -np.expm1(-((e / 0.0525) ** 2))
        if servo is UNSHAPED_SERVO:
            wanted = e / 0.02
        return [y[1], (wanted - y[1]) / lag]

    times = np.arange(1, 200) * CYCLE
    exact = solve_ivp(slope, (0.0, 0.2), [0.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y
    q, dq = moved(np.full(len(times), target), servo, lag)
    # A cycle moves at the velocity of its end: half a cycle ahead.
    top = np.max(np.abs(exact[1]))
    np.testing.assert_allclose(q, exact[0], atol=0.55 * CYCLE * top)
    np.testing.assert_allclose(dq, exact[1], atol=3e-3 * top)


# The linear lag, and none.


def test_a_lag_takes_up_a_step_as_an_exponential():
    lag = 0.012
    q, _ = moved(np.full(100, 0.3), ActuatorParameters(LAG), lag)
    times = np.arange(1, 101) * CYCLE
    np.testing.assert_allclose(q, 0.3 * (1.0 - np.exp(-times / lag)), rtol=1e-12)


def test_without_an_actuator_a_joint_is_where_it_is_sent():
    targets = np.array([0.1, -0.2, 0.2])
    q, dq = moved(targets, ActuatorParameters(IDEAL), 0.5)
    np.testing.assert_allclose(q, targets, rtol=1e-12)
    np.testing.assert_allclose(dq, np.diff(targets, prepend=0.0) / CYCLE)
    assert steady_error(1.0, 0.5, ActuatorParameters(IDEAL)) == 0.0


@pytest.mark.compiled_only  # plain Python has no lanes, and warns where a series overflows unused
@pytest.mark.parametrize("error", [0.1, NEAR * INTERVAL_WIDTH / 2.0])
@pytest.mark.parametrize("kind", [IDEAL, LAG, UNSHAPED, KST])
def test_each_lane_and_joint_moves_alone(kind, error):
    # Small errors alone take the short series, with others among them the whole law.
    rng = np.random.default_rng(2)
    target, q = rng.uniform(-error, error, (2, 6, BATCH_SIZE))
    dq, fraction = rng.uniform(-0.5, 0.5, q.shape), rng.uniform(0.05, 1.0, q.shape)
    actuator, together = ActuatorParameters(kind), servos(q, dq, target, fraction)
    follow_cycles(together, actuator, 5, BATCH_SIZE)
    for joint, lane in np.ndindex(q.shape):
        its = (block[joint, lane] for block in (q, dq, target, fraction))
        alone = servos(*its)
        follow_cycles(alone, actuator, 5, 1)
        for name in ("q", "dq"):
            assert alone[name][0, 0, 0] == together[name][0, joint, lane]


# A whole log.


def tracked(stream_time, stream_q, reply_time, reply_q, kind=KST, **options):
    given = {"delay": 0.0, "lag": 0.008, "actuator": ActuatorParameters(kind), **options}
    return track(stream_time, stream_q, reply_time, reply_q, JointResponse(**given))


@pytest.mark.parametrize(
    ("kind", "lag"), [(KST, 0.008), (KST, 0.0), (UNSHAPED, 0.008), (LAG, 0.008), (IDEAL, 0.0)]
)
def test_a_log_is_simulated_as_the_servo_moves(kind, lag):
    # Setpoints that take effect on the cycles' own grid: the very loop of `follow`.
    time = np.arange(0.0, 0.6, 0.005)
    stream = 0.1 * (1.0 - np.cos(6.0 * time))
    cycles = np.arange(600)
    targets = stream[np.maximum((cycles[:-1] - 10) // 5, 0)]
    expected, _ = moved(targets, ActuatorParameters(kind), lag)
    found = tracked(time, stream, cycles * CYCLE, np.zeros(600), kind, delay=0.010, lag=lag)
    np.testing.assert_allclose(found[1:], expected, atol=1e-9)


def test_a_push_holds_a_joint_off_its_setpoint_by_the_error_that_balances_it():
    time = np.arange(0.0, 2.0, 0.005)
    replies = np.arange(0.0, 1.9, 0.005)
    found = tracked(time, np.zeros(len(time)), replies, np.zeros(len(replies)), push=0.2)
    balance = INTERVAL_WIDTH * sqrt(-np.log(1.0 - 0.2 * CYCLE / AMPLITUDE))
    assert found[-1] == pytest.approx(balance, rel=1e-3)
    linear = tracked(time, np.zeros(len(time)), replies, np.zeros(len(replies)), LAG, push=0.01)
    assert linear[-1] == pytest.approx(0.01)


def test_the_response_time_is_the_lag_and_the_slope_of_the_shaping_law():
    lag, speed, h = 0.008, 0.1, 1e-7
    actuator = Actuator.assumed("kst", lag=lag)
    assert actuator.parameters == ActuatorParameters(KST, 1e-3, 0.07, 0.0525)
    e = steady_error(speed, lag, actuator.parameters)
    slope = (shaped_step(e + h, 0.07, 0.0525) - shaped_step(e - h, 0.07, 0.0525)) / (2 * h) / 1e-3
    assert actuator.response_time(0, speed) == pytest.approx(lag + 1.0 / slope, rel=1e-5)
    assert Actuator.assumed("lag", lag=lag).response_time(0) == lag
    assert Actuator.assumed("ideal").response_time(0) == 0.0
    assert actuator.response_time(0, 0.0) == float("inf")
    for impossible in ({"delay": -1e-3}, {"lag": -1e-3}, {"cycle": 0.0}):
        with pytest.raises(ValueError, match="is not from"):
            Actuator.assumed("kst", **impossible)
