"""The velocity servo: its driver in virtual time, and the guard that ends it."""

import math
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from equipoise.devices.kuka import codec
from equipoise.devices.kuka.velocity_guard import DECELERATION, MAX_SILENCE, PERIOD, VelocityGuard
from equipoise.devices.kuka.velocity_robot import KstVelocityRobot
from tests.devices.kuka.follower import HOME, Bench
from tests.devices.kuka.test_listener import Served

SWING = 0.1, 0.7
"""Amplitude [rad] and frequency [Hz] of a motion of the first joint."""


def swing(t):
    size, frequency = SWING
    return (size * math.sin(2.0 * math.pi * frequency * t) ** 2, *HOME[1:])


def test_the_arm_follows_setpoints_in_spite_of_jitter_and_drift():
    """Every 20th setpoint is late by 8 ms: 0.4 mrad each that the integral runs too far."""
    bench = Bench(delay=0.001)
    robot = KstVelocityRobot(lambda: bench.client, bench.clock)
    robot.connect()
    robot.start()
    begin, missed = bench.clock.now(), []
    for number in range(12000):
        t = 0.005 * number
        bench.clock.wait_until(begin + t + (0.008 if number % 20 == 0 else 0.0))
        robot.send(swing(t))
        robot.replies()
        # The follower is at the setpoint a setpoint and its lag and the link later.
        missed.append(bench.body.measured()[0] - swing(bench.clock.now() - begin - 0.011)[0])
    assert np.abs(missed[1000:]).max() < 0.006
    assert np.abs(np.mean(missed[-2000:])) < 1e-3
    robot.stop()
    at_rest = bench.body.measured()
    bench.wait(1.0)
    assert bench.body.measured() == pytest.approx(at_rest, abs=1e-6)


def lines(data):
    return data.decode().splitlines()


def test_the_guard_slows_the_arm_down_stops_the_servo_and_ends_the_server():
    guard, moving = VelocityGuard(), codec.velocity((0.4, *HOME[1:]))
    assert guard.hear(moving, 1.0) == moving
    assert guard.due(1.0 + 0.99 * MAX_SILENCE) == b""
    said = [
        line for k in range(400) for line in lines(guard.due(1.0 + MAX_SILENCE + 1e-3 * (k + 1)))
    ]
    *slowing, stop, end = said
    assert (stop, end) == ("stopDirectServoJoints", "end")
    speeds = np.array([[float(v) for v in line.split("_")[1:-1]] for line in slowing])
    steps = np.diff(speeds, axis=0, prepend=[(0.4, *HOME[1:])])
    assert np.abs(steps).max() <= DECELERATION * PERIOD * (1.0 + 1e-9)
    assert not speeds[-1].any()
    assert guard.hear(moving, 2.0) == b""
    assert guard.done


def test_the_guard_leaves_a_silent_driver_of_a_resting_arm_alone():
    guard = VelocityGuard()
    guard.hear(codec.velocity((0.1, *HOME[1:])), 1.0)
    guard.hear(codec.velocity((0.0,) * 7), 1.01)
    assert guard.due(60.0) == b""
    assert not guard.acts


DRIVER = """
    import sys, time
    from equipoise.devices.clocks import SystemClock
    from equipoise.devices.kuka.plugin import {name}
    from equipoise.devices.plugins import Session

    clock = SystemClock()
    robot = {name}.open("kst://127.0.0.1:" + sys.argv[1], Session(clock))
    robot.connect()
    robot.start()
    q, moment = robot._last[1], clock.now()
    for number in range(10000):
        robot.send((q[0] + 0.0015 * number, *q[1:]))
        robot.replies()
        if number == 20:
            print("moving", flush=True)
        moment += 0.005
        clock.wait_until(moment)
"""


def moving():
    """Return a server whose arm moves, and the process of its driver.

    A machine under load may hold the driver up for so long that the guard ends it: another tries.
    """
    program = textwrap.dedent(DRIVER.format(name="VELOCITY_PLUGIN"))
    for _ in range(10):
        served = Served()
        command = [sys.executable, "-c", program, str(served.port)]
        driver = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        if driver.stdout.readline() == "moving\n":
            return served, driver
        driver.kill()
        driver.wait()
        served.close()
    raise AssertionError("no driver moved the arm")


@pytest.mark.skipif(sys.platform == "win32", reason="the guard inherits sockets")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_the_arm_comes_to_rest_when_the_process_of_its_driver_dies_or_hangs(end):
    served, driver = moving()
    try:
        driver.send_signal(end)
        killed_at = served.body.measured()[0]
        served.thread.join(3.0)
        assert not served.thread.is_alive(), "the guard ends the server"
        # 0.3 rad/s for the silence, the ramp, and a machine under load.
        assert killed_at < served.body.measured()[0] < killed_at + 0.1
        assert not served.body.running
    finally:
        driver.kill()
        driver.wait()
        served.close()


def test_without_a_guard_the_arm_moves_on():
    bench = Bench()
    robot = KstVelocityRobot(lambda: bench.client, bench.clock)
    robot.connect()
    robot.start()
    for number in range(20):
        robot.send((0.0015 * number, *HOME[1:]))
        bench.wait(0.005)
    bench.wait(10.0)
    assert bench.body.measured()[0] > 3.0
