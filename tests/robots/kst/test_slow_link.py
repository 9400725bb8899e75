"""How fast the flange may move over a slow link, against a servo simulated cycle by cycle."""

from math import expm1, sqrt

import numpy as np
import pytest

from equipoise.arm.iiwa import iiwa
from equipoise.model.actuator import AMPLITUDE, CYCLE, INTERVAL_WIDTH
from equipoise.model.worlds import TwinSettings
from equipoise.robots.kst.plugin import T1_SPEED, flange_speed
from equipoise.simulation.twin.servo_model import new_servo, send, serve, start

WORLD = TwinSettings(transport=0.0, transport_jitter=0.0)
IIWA = {size: iiwa(size) for size in (7, 14)}


def shaped_peak(speed, period):
    """Return the peak velocity command of the shaping law for constant-speed setpoints [rad/s]."""
    half, k = 0.5 * speed * period, AMPLITUDE / (INTERVAL_WIDTH**2 * CYCLE)
    e = half + sqrt(half**2 + speed / k)
    return AMPLITUDE / CYCLE * -expm1(-((e / INTERVAL_WIDTH) ** 2))


def peak_of_the_cabinet(speed, period_ms):
    """Return the largest velocity that the cabinet asks its drives for [rad/s].

    A joint turns evenly; a setpoint comes each period. The drive is perfect.
    """
    arm = IIWA[7]
    servo, n = new_servo(arm, WORLD), 7
    q, dq, nothing, force = (np.zeros(n) for _ in range(4))
    start(servo, q)
    peaks = []
    for ms in range(400):
        if ms % period_ms == 0:
            send(servo, np.full(n, speed * ms * 1e-3), ms, 0, 0)
        serve(servo, ms, q, dq, nothing, force)
        dq[:] = servo.velocity
        q += 1e-3 * dq
        peaks.append(abs(servo.velocity[0]))
    return max(peaks[200:])  # after the start


@pytest.mark.parametrize(("period_ms", "speed"), [(5, 0.8), (15, 0.1)])
def test_the_shaped_peak_is_that_of_the_cabinet_with_a_perfect_drive(speed, period_ms):
    peak = peak_of_the_cabinet(speed, period_ms)
    # The law is quadratic only near zero, and the server looks once a millisecond: both make the
    # peak of the cabinet smaller, never larger.
    assert peak <= shaped_peak(speed, 1e-3 * period_ms) <= 1.12 * peak


@pytest.mark.parametrize("size", [7, 14])
def test_at_the_limit_the_worst_joint_has_a_peak_of_80_percent_of_its_speed(size):
    arm, period = IIWA[size], 0.008
    limit = flange_speed(arm, period)
    fractions = []
    for x in np.linspace(-0.22, 0.22, 23):
        # Found by Newton's method, where the limit follows the track from home.
        q, home = arm.home_free, arm.kinematics(arm.home_free)
        for _ in range(20):
            here = arm.kinematics(q)
            turn = 0.5 * sum(np.cross(here.rotation[:, i], home.rotation[:, i]) for i in range(3))
            away = np.concatenate((home.position + np.array([x, 0.0, 0.0]) - here.position, turn))
            q = q + np.linalg.solve(here.jacobian, away)
        dq = np.linalg.solve(arm.kinematics(q).jacobian, limit * np.eye(6)[0])
        for rate, joint in zip(dq, arm.free_joints, strict=True):
            fractions.append(shaped_peak(abs(rate), period) / joint.velocity)
    assert max(fractions) == pytest.approx(0.8, rel=0.01)
    # The slower the link, the slower the flange; T1 is slower than any link that a run allows.
    assert limit > flange_speed(arm, 0.009) > T1_SPEED
