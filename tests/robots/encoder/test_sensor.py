"""The driver of an encoder board, in virtual time: what it gives out, drops and refuses."""

from math import pi, sin

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.robots.encoder.codec import Reading, decode, encode
from equipoise.robots.encoder.sensor import MAX_INCONSISTENT
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
    bench = Bench()
    bench.clock.wait_until(1.0)
    bench.clock.attach(
        lambda now: bench.board.reboot() if abs(now - 1.001 - restart) < 1e-4 else None
    )
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
        (lambda bench: setattr(bench.board, "silent", True), "sent no valid line", 0.52),
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
    bench.board.slipped = counts
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
