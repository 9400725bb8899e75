"""Lines that come late, and later or earlier from some time on: no healthy board has restarted.

A step down of the delay delivers many lines at once, as a serial link keeps their order.
"""

import itertools
from math import sin

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.robots.encoder.codec import Banner, decode, encode
from equipoise.robots.encoder.consistency import MAX_INCONSISTENT, MAX_LATENESS, SILENCE
from tests.robots.encoder.rig import Bench

QUICK = 0.001
"""Delay of a link in time [s]."""
ALL_DELAYS = (0.005, 0.016, 0.020, 0.035, 0.050, 0.100, 0.200)
"""From a USB adapter's latency timer to a host that stands still [s]."""
DELAYS = [
    late if late in (0.016, 0.035, 0.2) else pytest.param(late, marks=pytest.mark.slow)
    for late in ALL_DELAYS
]


def swinging(time):
    return 1.2 * sin(8.4 * time)


def delayed(*steps, motion=None, **board):
    """Return a bench whose delay changes, at times and to delays that `steps` give [s]."""
    bench, steps = Bench(**board), list(steps)
    bench.motion = motion

    def work(now):
        while steps and now >= steps[0][0]:
            bench.device.delay = steps.pop(0)[1]

    bench.clock.attach(work)
    return bench


def assert_times_are_right(bench, samples, delay=QUICK):
    """Assert that no sample is lost, that times grow, and that the last one is true by now."""
    assert min(b.time - a.time for a, b in itertools.pairwise(samples)) > 0.0
    assert sum(sample.missing for sample in samples) == bench.sensor.rejected == 0
    assert bench.clock.now() - samples[-1].time == pytest.approx(delay, abs=0.001)


@pytest.mark.parametrize("late", DELAYS)
@pytest.mark.parametrize(
    "until", [0.1, 0.25, 0.6, *(pytest.param(t, marks=pytest.mark.slow) for t in (0.05, 0.35, 1.0))]
)
@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_lines_late_while_connecting_and_in_time_afterwards_are_followed(late, until, drift):
    # The clock of the board wraps after half a second.
    bench = delayed(
        (0.0, late), (until, QUICK), motion=swinging, drift=drift, offset_us=2**32 - 500_000
    )
    bench.sensor.connect()
    assert_times_are_right(bench, bench.run(2.0))


@pytest.mark.parametrize("lost", [0, 15, 40])
@pytest.mark.parametrize("late", DELAYS)
def test_lines_in_time_again_while_it_swings_are_named_late(late, lost):
    bench = delayed((0.0, late), (2.0, QUICK), motion=swinging)
    bench.sensor.connect()
    bench.run(1.6)
    bench.clock.wait_until(2.0)
    bench.board.skip(lost)
    if late <= MAX_LATENESS:
        samples = bench.run(1.0)
        assert sum(sample.missing for sample in samples) == lost
        return
    with pytest.raises(LinkError, match=r"delivers its lines \d+ ms late") as caught:
        bench.run(1.0)
    assert "anew" not in str(caught.value)


def assert_true(samples, tolerance):
    """Assert that each sample has the angle of its time, to a tolerance [s] at 10 rad/s."""
    for sample in samples:
        theta = sample.counts * 2.0 * np.pi / 8192
        assert abs(theta - swinging(sample.time - QUICK)) < 10.0 * tolerance + 1e-3


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
    samples = bench.run(3.0)
    assert not any(sample.missing for sample in samples)
    assert_true(samples, 0.005)  # the time between two looks


@pytest.mark.parametrize("late", [QUICK, 0.1])
@pytest.mark.parametrize("after", [0.05, 2.0])
def test_a_restart_is_found_however_late_lines_come(late, after):
    bench = delayed((0.0, late))
    bench.sensor.connect()
    bench.run(after)
    bench.garble = lambda data: b"" if isinstance(decode(data[:-1]), Banner) else data
    bench.board.reboot()
    with pytest.raises(LinkError, match="began anew"):
        bench.run(0.3 + late + 0.02)


@pytest.mark.parametrize("still", [True, False])
def test_sequence_and_clock_that_jump_ahead_together_are_no_lateness(still):
    bench = Bench()
    bench.motion = None if still else swinging
    bench.sensor.connect()
    bench.run(2.5)

    def ahead(data):
        said = decode(data[:-1])
        seq, t_us = said.seq + 600, said.t_us + 600_000
        return encode(said._replace(seq=seq % 2**16, t_us=t_us % 2**32, counts=0))

    assert SILENCE < 0.6
    bench.garble = ahead
    bench.motion = None
    with pytest.raises(LinkError, match="began anew"):
        bench.run(0.1)
    assert bench.sensor.rejected == MAX_INCONSISTENT
