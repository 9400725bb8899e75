"""Minimum-jerk paths: their ends, their peaks, their smoothness."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.control.minimum_jerk import Path, path_within

WAY = Path((0.0, 1.0), (1.0, -1.0), 2.0)


def series(path, n=4001):
    time = np.linspace(0.0, path.duration, n)
    points = [path.at(t) for t in time]
    return time, *(np.array([getattr(p, name) for p in points]) for name in ("q", "dq", "ddq"))


def test_it_rests_at_both_ends_and_beyond():
    for time, place in ((-1.0, WAY.start), (0.0, WAY.start), (2.0, WAY.end), (9.0, WAY.end)):
        q, dq, ddq = WAY.at(time)
        assert q == place
        assert dq == ddq == (0.0, 0.0)


def test_velocity_and_acceleration_are_the_derivatives():
    time, q, dq, ddq = series(WAY)
    h = time[1]
    np.testing.assert_allclose(np.gradient(q, h, axis=0)[1:-1], dq[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(dq, h, axis=0)[1:-1], ddq[1:-1], atol=1e-4)


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=7),
    st.floats(0.1, 3.0),
    st.floats(0.1, 20.0),
)
def test_the_quickest_path_reaches_a_limit_and_passes_none(ends, velocity, acceleration):
    start, end = zip(*ends, strict=True)
    path = path_within(start, end, [velocity] * len(ends), [acceleration] * len(ends))
    assert path.start == start
    assert path.end == end
    if path.duration < 1e-6:
        assert np.max(np.abs(np.subtract(end, start))) < 1e-12
        return
    _, _, dq, ddq = series(path, 2001)
    used = max(np.abs(dq).max() / velocity, np.abs(ddq).max() / acceleration)
    # The grid may miss the peaks of the acceleration by 1e-6.
    assert used == pytest.approx(1.0, abs=1e-5)
