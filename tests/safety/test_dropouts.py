"""Gaps in the encoder's samples: which are let pass, and which stop a run."""

from math import nan

import pytest

from equipoise.safety.dropouts import DROPOUT_WINDOW, MAX_DROPOUTS, DropoutMonitor


@pytest.mark.parametrize(("missing", "serious"), [(0, 0), (1, 0), (2, 2), (3, 3), (500, 500)])
def test_one_missing_sample_is_bridged_and_no_more(missing, serious):
    gaps = DropoutMonitor()
    assert gaps.serious(3.0, missing) == serious
    assert gaps.bridged == (missing == 1)


def test_samples_that_follow_each_other_are_no_gaps():
    gaps = DropoutMonitor()
    for ms in range(100):
        assert gaps.serious(1e-3 * ms, 0) == 0
    assert gaps.serious(0.1, 1) == 0
    assert gaps.bridged == 1


def test_the_third_within_a_second_stops_and_one_after_it_does_not():
    for last, serious in ((1.0, 1), (1.0 + 1e-9, 0)):
        gaps = DropoutMonitor()
        assert [gaps.serious(time, 1) for time in (0.0, 0.5, last)] == [0, 0, serious]


def test_gaps_are_counted_in_any_window_of_a_second():
    gaps = DropoutMonitor()
    assert gaps.serious(0.0, 0) == 0
    assert gaps.serious(0.0, 1) == 0
    assert gaps.serious(0.6, 1) == 0
    assert gaps.serious(0.5 + DROPOUT_WINDOW, 1) == 0  # two in this second
    assert gaps.serious(0.59 + DROPOUT_WINDOW, 1) == 1  # three
    assert gaps.bridged == MAX_DROPOUTS
    assert gaps.serious(9.0, 2) == 2
    # One of several samples counts towards what comes often.
    assert gaps.serious(9.1, 1) == 0
    assert gaps.serious(9.2, 1) == 1


def test_a_gap_at_no_time_is_not_bridged():
    gaps = DropoutMonitor()
    for _ in range(MAX_DROPOUTS):
        serious = gaps.serious(nan, 1)
    assert serious == 1
