"""Disturbances that repeat: which are let pass, and which stop a run."""

from math import nan

import pytest

from equipoise.safety.repeats import REPEAT_WINDOW, RepeatMonitor


@pytest.mark.parametrize(
    ("times", "often"),
    [
        ([3.0], []),
        # The third within a second stops, and one after it does not.
        ([0.0, 0.5, 1.0], [1.0]),
        ([0.0, 0.5, 1.0 + 1e-9], []),
        # In any window of a second, and again.
        ([0.0, 0.6, 0.5 + REPEAT_WINDOW, 0.59 + REPEAT_WINDOW], [0.59 + REPEAT_WINDOW]),
        ([9.0, 9.1, 9.2, 9.3], [9.2, 9.3]),
    ],
)
def test_two_within_a_second_are_bridged_and_no_more(times, often):
    monitor = RepeatMonitor()
    assert [time for time in times if monitor.add(time)] == often


def test_a_time_that_is_no_number_is_one_too_many():
    assert RepeatMonitor().add(nan)
