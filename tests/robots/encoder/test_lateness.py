"""Lines that come late, and later or earlier from some time on: no healthy board has restarted.

A step down of the delay delivers many lines at once, as a serial link keeps their order.
"""

from itertools import pairwise
from math import pi, sin

import pytest

from equipoise.errors import LinkError
from equipoise.robots.encoder.codec import Banner, decode
from equipoise.robots.encoder.sensor import MAX_LATENESS
from tests.robots.encoder.rig import Bench

QUICK = 0.001
"""Delay of a link in time [s]."""
DELAYS = (0.005, 0.016, 0.035, 0.2)
"""From a USB adapter's latency timer to a host that stands still [s]."""


def swinging(time):
    return 1.2 * sin(8.4 * time)


def delayed(late, until, **board):
    """Return a bench whose lines are late until a time [s]."""
    bench = Bench(**board)
    bench.motion = swinging

    def work(now):
        bench.device.delay = late if now < until else QUICK

    bench.clock.attach(work)
    return bench


@pytest.mark.parametrize("late", DELAYS)
@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_lines_late_while_connecting_and_in_time_afterwards_are_followed(late, drift):
    # The clock of the board wraps after half a second.
    bench = delayed(late, 0.1, drift=drift, offset_us=2**32 - 500_000)
    bench.sensor.connect()
    samples = bench.run(2.0)
    # No sample is lost, times grow, and the last one is true by now.
    assert min(b.time - a.time for a, b in pairwise(samples)) > 0.0
    assert sum(sample.missing for sample in samples) == bench.sensor.rejected == 0
    assert bench.clock.now() - samples[-1].time == pytest.approx(QUICK, abs=0.001)


@pytest.mark.parametrize("lost", [0, 40])
@pytest.mark.parametrize("late", DELAYS)
def test_lines_in_time_again_later_are_named_late(late, lost):
    bench = delayed(late, 2.0)
    bench.sensor.connect()
    bench.run(1.6)
    bench.clock.wait_until(2.0)
    bench.board.skipped = lost
    if late <= MAX_LATENESS:
        assert sum(sample.missing for sample in bench.run(1.0)) == lost
        return
    with pytest.raises(LinkError, match=r"delivers its lines \d+ ms late"):
        bench.run(1.0)


@pytest.mark.parametrize("held", [0.016, 0.1])
def test_lines_that_an_adapter_delivers_together_have_their_own_times(held):
    bench = Bench()
    bench.motion = swinging
    waiting = bytearray()

    def in_bursts(data):
        waiting.extend(data)
        if round(bench.clock.now() * 1000) % round(held * 1000):
            return b""
        data = bytes(waiting)
        waiting.clear()
        return data

    bench.garble = in_bursts
    bench.sensor.connect()
    for sample in bench.run(3.0):
        assert not sample.missing
        # Looks are 5 ms apart, at 10 rad/s.
        theta = sample.counts * 2.0 * pi / 8192
        assert abs(theta - swinging(sample.time - QUICK)) < 10.0 * 0.005 + 1e-3


@pytest.mark.parametrize(("late", "after"), [(QUICK, 0.05), (0.1, 2.0)])
def test_a_restart_is_found_however_late_lines_come(late, after):
    bench = delayed(late, 9.0)
    bench.sensor.connect()
    bench.run(after)
    bench.garble = lambda data: b"" if isinstance(decode(data[:-1]), Banner) else data
    bench.board.reboot()
    with pytest.raises(LinkError, match="began anew"):
        bench.run(0.3 + late + 0.02)
