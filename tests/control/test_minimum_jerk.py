"""Minimum-jerk paths: their ends, their peaks, their smoothness."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.control.minimum_jerk import MinimumJerk, path_within

WAY = MinimumJerk((0.0, 1.0), (1.0, -1.0), 2.0)


def series(path, n=4001):
    time = np.linspace(0.0, path.duration, n)
    points = [path.at(t) for t in time]
    q, dq = map(np.array, zip(*points, strict=True))
    return time, q, dq, np.gradient(dq, time, axis=0)


def test_it_rests_at_both_ends_and_beyond():
    for time, place in ((-1.0, WAY.start), (0.0, WAY.start), (2.0, WAY.end), (9.0, WAY.end)):
        assert WAY.at(time) == (place, (0.0, 0.0))


def test_the_velocity_is_the_derivative_and_the_jerk_is_continuous():
    time, q, dq, ddq = series(WAY)
    np.testing.assert_allclose(np.gradient(q, time, axis=0)[1:-1], dq[1:-1], atol=1e-5)
    # The sixth differences of a polynomial of fifth order vanish.
    sixth = np.diff([WAY.at(t).q for t in np.linspace(0.0, 2.0, 21)], n=6, axis=0)
    np.testing.assert_allclose(sixth, 0.0, atol=1e-12)
    np.testing.assert_allclose(ddq[[0, -1]], 0.0, atol=0.02)


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
    # The grid may miss the peaks, and differences flatten them.
    assert used == pytest.approx(1.0, abs=1e-4)
