"""The board's time on the host's clock."""

import itertools

import pytest

from equipoise.robots.encoder.mapping import MAX_CLOCK_ERROR, SLEW, HostTime


def test_while_settling_the_fastest_line_decides_at_once():
    host = HostTime(0, 10.050)
    assert host.lateness == 0.0
    # 50 ms late, then 40 ms, then 1 ms, then 30 ms.
    for t_us, late in ((1000, 0.040), (2000, 0.001), (3000, 0.030)):
        host.settle(t_us, 10.0 + 1e-6 * t_us + late)
    assert host(4000, 10.004 + 0.007) == pytest.approx(10.004 + 0.001, abs=2e-6)
    assert host.lateness == pytest.approx(0.006, abs=2e-6)


def test_the_guess_rises_by_no_more_than_a_slow_clock_explains():
    assert MAX_CLOCK_ERROR == 1e-3
    host = HostTime(0, 0.0)
    times = [host(1000 * i, 1e-3 * i + 0.5) for i in range(1, 1001)]
    assert times[-1] == pytest.approx(1.0 + 1e-3, abs=1e-9)
    assert host.lateness == pytest.approx(0.499, abs=1e-9)


def test_the_guess_falls_without_any_time_going_back():
    host = HostTime(0, 0.020)
    times = [host(1000 * i, 1e-3 * i) for i in range(1, 301)]
    assert min(b - a for a, b in itertools.pairwise(times)) >= 1e-3 * (1.0 - SLEW) - 1e-9
    assert times[-1] == pytest.approx(0.3, abs=1e-9)
    assert times[99] == pytest.approx(0.1 + 0.010, abs=1e-9)


def test_the_wrap_of_the_boards_clock_is_passed_over():
    host = HostTime(2**32 - 1000, 5.0)
    assert host.ahead(1000, 5.002) == pytest.approx(0.0, abs=1e-9)
    assert host(1000, 5.002) == pytest.approx(5.002, abs=1e-9)
    assert host.ahead(501_000, 5.003) == pytest.approx(0.499, abs=1e-9)
