"""Text for values: it claims no more than was measured."""

import pytest

from equipoise.worlds.formatting import plus_minus


@pytest.mark.parametrize(
    ("value", "low", "high", "text"),
    [
        (70.2, 70.1, 70.3, "70.20 ± 0.10"),
        (0.15, 0.14, 0.17, "0.150 ± 0.020"),
        (1234.0, 1100.0, 1368.0, "1234 ± 134"),
        (70.2, 70.2, 70.2, "70.2"),
    ],
)
def test_a_value_shows_the_digits_that_its_interval_supports(value, low, high, text):
    assert plus_minus(value, (low, high)) == text
