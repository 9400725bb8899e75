"""The driver of an encoder board, in virtual time: what it gives out, drops and refuses."""

from itertools import pairwise
from math import inf, pi, sin

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.robots.encoder.codec import Banner, Reading, decode, encode
from equipoise.robots.encoder.sensor import MAX_INCONSISTENT, MAX_LATENESS
from tests.robots.encoder.rig import Bench

RESOLUTION = 2.0 * pi / 8192


@pytest.fixture
def bench():
    bench = Bench()
    bench.sensor.connect()
    bench.run(0.1)
    return bench


def swinging(time):
    return 1.2 * sin(8.4 * time)


@pytest.mark.parametrize("drift", [0.0, 9e-4, -9e-4])
def test_each_sample_is_the_angle_at_its_time(drift):
    # The clock of the board wraps after two seconds.
    bench = Bench(drift=drift, offset_us=2**32 - 2_000_000)
    bench.motion = swinging
    bench.sensor.connect()
    samples = bench.run(5.0)
    time = np.array([sample.time for sample in samples])
    counts = np.array([sample.counts for sample in samples])
    assert len(samples) == pytest.approx(5_000, abs=15)
    assert np.all(np.diff(time) > 0.8e-3)
    # A line takes 1 ms, which nobody can see from one end; looks are 5 ms apart.
    theta = np.array([swinging(t - 0.001) for t in time])
    assert np.max(np.abs(counts * RESOLUTION - theta)) < 0.5 * RESOLUTION + 10.0 * 1.1e-3
    assert all(sample.missing == 0 and not sample.illegal for sample in samples)


def test_counts_and_sequence_wrap_unnoticed_and_the_sign_makes_counts_grow():
    bench = Bench(sign=-1, sensor_sign=-1)
    seen = []

    def shifted(data):
        lines = [decode(line) for line in data.split(b"\n")[:-1]]
        for i, said in enumerate(lines):
            if isinstance(said, Reading):
                counts = (said.counts + 50) % 2**32 - 2**31
                lines[i] = said._replace(counts=counts, seq=(said.seq + 65_000) % 65_536)
                seen.append(counts)
        return b"".join(map(encode, lines))

    bench.garble = shifted
    bench.motion = lambda time: max(0.0, time - 0.3)
    bench.sensor.connect()
    samples = bench.run(2.0)
    assert seen[0] < 0 < seen[-1]
    counts = [sample.counts for sample in samples]
    assert np.all(np.diff(counts) >= 0)
    turned = samples[-1].time - 0.3
    assert counts[-1] - counts[0] == pytest.approx(turned / RESOLUTION, abs=5)
    assert sum(sample.missing for sample in samples) == bench.sensor.rejected == 0


def test_button_and_illegal_transitions_are_told_once(bench):
    for press in (True, False):
        bench.board.press(press)
    bench.board.illegal = True
    samples = bench.run(0.1)
    assert sum(sample.pressed for sample in samples) == 1
    assert sum(sample.illegal for sample in samples) == 1


def test_a_board_of_other_counts_is_refused():
    with pytest.raises(LinkError):
        Bench(expected=4096).sensor.connect()


@pytest.mark.parametrize("restart", [0.0, 0.4])
def test_a_board_that_restarts_while_connecting_is_timed_again(restart):
    # At once, since its port is opened; or later.
    bench, again = Bench(), 1.001 + restart
    bench.clock.wait_until(1.0)
    bench.clock.attach(lambda now: bench.board.reboot() if abs(now - again) < 1e-4 else None)
    bench.sensor.connect()
    samples = bench.run(0.1)
    assert len(samples) == pytest.approx(100, abs=8)
    assert abs(samples[-1].time - bench.clock.now()) < 0.01


def failing(bench, saying, within=1.0):
    """Read until the sensor fails; return when it did, and see that it stays failed."""
    began = bench.clock.now()
    with pytest.raises(LinkError, match=saying) as first:
        bench.run(within)
    with pytest.raises(LinkError) as again:
        bench.sensor.samples()
    assert str(again.value) == str(first.value)
    return bench.clock.now() - began


@pytest.mark.parametrize(
    ("fail", "saying", "within"),
    [
        (lambda bench: bench.unplug(), "is gone: the other end has closed", 0.02),
        (lambda bench: bench.lose(inf), "sent no valid line", 0.52),
        (lambda bench: bench.board.reboot(), "its zero is void", 0.33),
    ],
)
def test_a_board_that_fails_is_an_error_that_stays(bench, fail, saying, within):
    bench.run(1.5)
    fail(bench)
    assert failing(bench, saying) < within


@pytest.mark.parametrize("counts", [60, -150, 2**28])
@pytest.mark.parametrize("turning", [False, True])
def test_a_jump_of_the_count_is_an_error(bench, counts, turning):
    if turning:
        began = bench.clock.now()
        bench.motion = lambda time: -np.sign(counts) * 15.0 * (time - began)
        bench.run(0.05)
        counts *= 4
    bench.slip = counts * RESOLUTION
    assert failing(bench, "jumped") < 0.02
    assert bench.sensor.rejected == MAX_INCONSISTENT


FORGED = {"counts": 60, "seq": -1, "t_us": 10**9, "both": 500}


@pytest.mark.parametrize(("field", "by"), [*FORGED.items(), ("counts", -(2**31)), ("t_us", -1_000)])
def test_a_wrong_line_with_a_right_checksum_is_dropped_alone(bench, field, by):
    """One line says something else under a right checksum: what slips through the codec."""
    lines = [0]

    def forged(data):
        said = decode(data[:-1])
        lines[0] += isinstance(said, Reading)
        if lines[0] != 50:
            return data
        if field == "both":
            return encode(said._replace(seq=said.seq + by, t_us=said.t_us + 1000 * by))
        return encode(said._replace(**{field: getattr(said, field) + by}))

    bench.garble = forged
    samples = bench.run(0.2)
    assert len(samples) == 199
    assert all(sample.counts == 0 for sample in samples)
    assert np.max(np.diff([sample.time for sample in samples])) < 2.2e-3
    assert bench.sensor.rejected == 1
    assert [sample.missing for sample in samples if sample.missing] == [1]


# Lines that come late, and later or earlier from some time on: no healthy board has restarted. A
# step down of the delay delivers many lines at once, as a serial link keeps their order.

QUICK = 0.001
"""Delay of a link in time [s]."""
DELAYS = (0.005, 0.016, 0.035, 0.2)
"""From a USB adapter's latency timer to a host that stands still [s]."""


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
    bench.lose(1e-3 * lost)
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
