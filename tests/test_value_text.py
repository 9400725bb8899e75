"""Text for values: it claims no more than was measured."""

import pytest

from equipoise.model.pendulum import shipped_pendulum
from equipoise.printable import as_text, plus_minus


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


def test_estimates_show_their_interval_and_source_wherever_they_stand():
    w2, c = shipped_pendulum().w2, shipped_pendulum().c
    both = as_text([w2, c]).splitlines()
    assert both == [as_text(w2), as_text(c)]
    assert all(
        line.endswith(f"(95 %, {each.source})") for line, each in zip(both, (w2, c), strict=True)
    )
