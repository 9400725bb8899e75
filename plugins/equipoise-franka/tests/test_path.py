"""The path between setpoints lies within what the guard checks of its setpoints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from equipoise_franka.path import MARGIN, SetpointPath

T = 0.005


def path_points(setpoints, late=lambda k: 0.0):
    """Add a setpoint of one joint each period; return times and joints of each millisecond."""
    path, times, q, ms = SetpointPath(np.zeros(1), T), [], [], 0

    def advance(until):
        nonlocal ms
        while 1e-3 * ms < until - 1e-9:
            times.append(1e-3 * ms)
            q.append(path.at(1e-3 * ms)[0])
            ms += 1

    for k, setpoint in enumerate(setpoints):
        time = T * k + late(k)
        advance(time)
        path.add(np.array([setpoint]), time)
    advance(T * len(setpoints) + 0.1)
    return np.array(times), np.array(q)


@given(st.lists(st.floats(-0.01, 0.01), min_size=3, max_size=40))
def test_no_point_is_further_out_faster_or_more_accelerated_than_the_setpoints(steps):
    setpoints = np.cumsum(np.cumsum(steps)) * 1e-2
    _, q = path_points(setpoints)
    knots = np.concatenate([[0.0] * 3, setpoints, [setpoints[-1]] * 3])
    assert min(knots) - 1e-12 <= q.min() <= q.max() <= max(knots) + 1e-12
    assert np.abs(np.diff(q)).max() <= np.abs(np.diff(knots)).max() * 1e-3 / T + 1e-12
    bend = np.abs(np.diff(knots, 2)).max() * (1e-3 / T) ** 2
    assert np.abs(np.diff(q, 2)).max() <= bend + 1e-12


def test_it_is_the_quadratic_b_spline_of_scipy():
    setpoints = 0.01 * np.sin(np.linspace(0.0, 3.0, 60))
    t, q = path_points(setpoints)
    knots = np.concatenate([[0.0], setpoints, [setpoints[-1]] * 2])
    # The setpoint k has the support from MARGIN + (k - 1) T to MARGIN + (k + 2) T.
    spline = BSpline(MARGIN + T * np.arange(-1, len(knots) + 2), knots, 2)
    inside = (t > MARGIN + T) & (t < T * len(setpoints))
    assert q[inside] == pytest.approx(spline(t[inside]), abs=1e-12)


def test_setpoints_that_come_late_within_the_margin_change_nothing():
    setpoints = 0.02 * np.sin(np.linspace(0.0, 3.0, 60))
    _, q = path_points(setpoints)
    _, late = path_points(setpoints, late=lambda k: MARGIN * (k % 2 if k else 0))
    assert late == pytest.approx(q, abs=1e-12)
