"""Virtual time advances by what was asked, however little, and the rig by whole milliseconds."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.rig.clocks import VirtualClock


@given(
    st.lists(st.one_of(st.sampled_from([5e-4, 1e-3, 0.005]), st.floats(1e-6, 0.02)), max_size=50)
)
def test_a_wait_ends_at_its_moment_and_each_millisecond_until_then_is_worked(durations):
    clock, worked = VirtualClock(), []
    clock.attach(worked.append)
    for duration in durations:
        moment = clock.now() + duration
        clock.wait_until(moment)
        assert moment <= clock.now() <= moment + 1e-9
    assert worked == pytest.approx([1e-3 * (k + 1) for k in range(len(worked))], abs=2e-9)
    assert -1e-9 <= clock.now() - 1e-3 * len(worked) < 1e-3
    now = clock.now()
    clock.wait_until(now - 1.0)
    assert clock.now() == now
