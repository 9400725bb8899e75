"""The path of a robot that sets the pace lies within what the guard checks of its setpoints."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from equipoise.arm.iiwa import iiwa
from equipoise.errors import LinkError
from equipoise.rig.clocks import VirtualClock
from equipoise_franka.paced import MARGIN, PacedStream
from equipoise_franka.robot import Request

T = 0.005
HOME = np.array(iiwa(7).home)


class Paced:
    """A robot that asks every millisecond."""

    joints = 7

    def __init__(self, clock):
        self.clock = clock
        self.streams, self.waiting, self.answers = False, deque(), []
        clock.attach(self.advance)

    def advance(self, now):
        if self.streams:
            self.waiting.append(Request(now, tuple(HOME), None))

    def connect(self):
        pass

    def measured(self):
        return HOME

    def start(self):
        self.streams = True

    def request(self, until):
        while not self.waiting and self.clock.now() < until:
            self.clock.wait_until(self.clock.now() + 1e-3)
        return self.waiting[0] if self.waiting else None

    def answer(self, q):
        self.waiting.popleft()
        self.answers.append((self.clock.now(), q))


def streamed(setpoints, late=lambda k: 0.0):
    """Send setpoints of the first joint from home, one each period; return times and answers."""
    clock = VirtualClock()
    robot = Paced(clock)
    stream = PacedStream(robot, clock, T)
    stream.connect()
    stream.start()
    home, began = stream.measured()[0], clock.now()
    for k, q in enumerate(setpoints):
        stream.wait_until(began + T * k + late(k))
        stream.send([home + q, *HOME[1:]])
    stream.wait_until(began + T * len(setpoints) + 0.1)
    answers = [(t - began, q[0] - home) for t, q in robot.answers if t > began - 1e-9]
    return np.array(answers).T


@given(st.lists(st.floats(-0.01, 0.01), min_size=3, max_size=40))
@settings(max_examples=30, deadline=None)  # each runs some hundred milliseconds of virtual time
def test_no_point_is_further_out_faster_or_more_accelerated_than_the_setpoints(steps):
    setpoints = np.cumsum(np.cumsum(steps)) * 1e-2
    _, q = streamed(setpoints)
    knots = np.concatenate([[0.0] * 3, setpoints, [setpoints[-1]] * 3])
    assert min(knots) - 1e-12 <= q.min() <= q.max() <= max(knots) + 1e-12
    assert np.abs(np.diff(q)).max() <= np.abs(np.diff(knots)).max() * 1e-3 / T + 1e-12
    bend = np.abs(np.diff(knots, 2)).max() * (1e-3 / T) ** 2
    assert np.abs(np.diff(q, 2)).max() <= bend + 1e-12


def test_it_is_the_quadratic_b_spline_of_scipy():
    setpoints = 0.01 * np.sin(np.linspace(0.0, 3.0, 60))
    t, q = streamed(setpoints)
    knots = np.concatenate([[0.0], setpoints, [setpoints[-1]] * 2])
    # The setpoint k has the support from MARGIN + (k - 1) T to MARGIN + (k + 2) T.
    spline = BSpline(MARGIN + T * np.arange(-1, len(knots) + 2), knots, 2)
    inside = (t > MARGIN + T) & (t < T * len(setpoints))
    assert q[inside] == pytest.approx(spline(t[inside]), abs=1e-12)


def test_setpoints_that_come_late_within_the_margin_change_nothing():
    setpoints = 0.02 * np.sin(np.linspace(0.0, 3.0, 60))
    times, q = streamed(setpoints)
    again, late = streamed(setpoints, late=lambda k: MARGIN * (k % 2 if k else 0))
    n = min(len(times), len(again))
    assert late[:n] == pytest.approx(q[:n], abs=1e-12)


@pytest.mark.parametrize("wrong", [0.1, -9.0, np.nan])
def test_a_start_that_the_first_request_contradicts_answers_nothing(wrong):
    for lies in ("measured", "request"):
        clock = VirtualClock()
        robot = Paced(clock)
        stream = PacedStream(robot, clock, T)
        if lies == "measured":
            robot.measured = lambda: HOME + wrong
        stream.start()
        if lies == "request":
            robot.waiting.append(Request(0.0, tuple(HOME + wrong), None))
        with pytest.raises(LinkError, match="from its posture at the start"):
            stream.wait_until(0.02)
        assert robot.answers == []
        with pytest.raises(LinkError, match="from its posture at the start"):
            stream.send(HOME)
