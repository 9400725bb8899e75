"""Gaps in the encoder's samples: which are let pass, and which stop a run."""

from math import nan

import pytest

from equipoise.safety.dropouts import DROPOUT_WINDOW, DropoutMonitor


@pytest.mark.parametrize(
    ("gaps", "bridged"),
    [
        # Time of each gap, samples missing, samples that stop the run.
        ([(3.0, 0, 0)], 0),
        ([(3.0, 1, 0)], 1),
        ([(3.0, 2, 2)], 0),
        ([(3.0, 500, 500)], 0),
        ([(1e-3 * ms, 0, 0) for ms in range(100)] + [(0.1, 1, 0)], 1),
        # The third within a second stops, and one after it does not.
        ([(0.0, 1, 0), (0.5, 1, 0), (1.0, 1, 1)], 2),
        ([(0.0, 1, 0), (0.5, 1, 0), (1.0 + 1e-9, 1, 0)], 3),
        # In any window of a second; one of several samples counts towards what comes often.
        (
            [(0.0, 1, 0), (0.6, 1, 0), (0.5 + DROPOUT_WINDOW, 1, 0), (0.59 + DROPOUT_WINDOW, 1, 1)],
            3,
        ),
        ([(9.0, 2, 2), (9.1, 1, 0), (9.2, 1, 1)], 1),
        ([(nan, 1, 1)], 0),
    ],
)
def test_single_gaps_are_bridged_and_no_more(gaps, bridged):
    monitor = DropoutMonitor()
    for time, missing, serious in gaps:
        assert monitor.serious(time, missing) == serious, time
    assert monitor.bridged == bridged
