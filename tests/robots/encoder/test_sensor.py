"""The driver of an encoder board, in virtual time: what it gives out, drops and refuses."""

from math import pi, sin

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.robots.encoder.codec import Reading, decode, encode
from equipoise.robots.encoder.consistency import MAX_INCONSISTENT
from equipoise.robots.encoder.sensor import LineEncoder
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


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4, 9e-4, -9e-4])
@pytest.mark.parametrize("offset_us", [0, 2**32 - 2_000_000])
def test_each_sample_is_the_angle_at_its_time(drift, offset_us):
    bench = Bench(drift=drift, offset_us=offset_us)
    bench.motion = swinging
    bench.sensor.connect()
    samples = bench.run(10.0)
    time = np.array([sample.time for sample in samples])
    counts = np.array([sample.counts for sample in samples])
    assert len(samples) == pytest.approx(10_000, abs=20)
    assert np.all(np.diff(time) > 0.8e-3)
    # A line takes 1 ms, which nobody can see from one end; looks are 5 ms apart.
    theta = np.array([swinging(t - 0.001) for t in time])
    assert np.max(np.abs(counts * RESOLUTION - theta)) < 0.5 * RESOLUTION + 10.0 * 1.1e-3
    assert all(sample.missing == 0 and not sample.illegal for sample in samples)


def test_counts_and_sequence_wrap_unnoticed():
    bench = Bench()
    shift = 2**31 - 50
    state = {}

    def shifted(data):
        lines = []
        for line in data.split(b"\n")[:-1]:
            said = decode(line)
            if isinstance(said, Reading):
                counts = (said.counts + shift + 2**31) % 2**32 - 2**31
                said = said._replace(counts=counts, seq=(said.seq + 65_000) % 65_536)
                state["last"] = said
            lines.append(encode(said))
        return b"".join(lines)

    bench.garble = shifted
    bench.motion = lambda time: max(0.0, time - 0.3) * 1.0
    bench.sensor.connect()
    samples = bench.run(2.0)
    assert state["last"].counts < 0
    assert np.all(np.diff([sample.counts for sample in samples]) >= 0)
    assert samples[-1].counts > 2**31
    assert sum(sample.missing for sample in samples) == bench.sensor.rejected == 0


def test_the_sign_makes_counts_grow_with_theta():
    for board, host in ((1, 1), (-1, -1)):
        bench = Bench(sign=board, sensor_sign=host)
        bench.motion = lambda time: time
        bench.sensor.connect()
        samples = bench.run(1.0)
        assert samples[-1].counts - samples[0].counts == pytest.approx(8192 / (2 * pi), rel=0.02)


def test_button_and_illegal_transitions_are_told_once(bench):
    bench.board.press()
    bench.board.press(False)
    bench.board.meet_illegal()
    samples = bench.run(0.1)
    assert sum(sample.pressed for sample in samples) == 1
    assert sum(sample.illegal for sample in samples) == 1
    bench.board.press()
    assert sum(sample.pressed for sample in bench.run(0.5)) == 1


def test_a_board_of_other_counts_is_refused():
    with pytest.raises(LinkError):
        Bench(expected=4096).sensor.connect()


def test_a_board_that_boots_when_its_port_is_opened_is_waited_for():
    bench = Bench()
    opened = bench.open

    def resetting():
        bench.board.reboot()
        return opened()

    bench.sensor._open = resetting
    bench.sensor.connect()
    assert len(bench.run(0.1)) == pytest.approx(100, abs=8)


def test_a_board_that_restarts_while_connecting_is_timed_again():
    bench = Bench()
    bench.clock.wait_until(1.0)
    restart = [1.1]

    def work(now):
        if restart and now > restart[0]:
            restart.clear()
            bench.board.reboot()

    bench.clock.attach(work)
    bench.sensor.connect()
    samples = bench.run(0.1)
    assert abs(samples[-1].time - bench.clock.now()) < 0.01


def failing(bench, saying, within=1.0):
    """Read until the sensor fails; return when it did, and see that it stays failed."""
    began = bench.clock.now()
    with pytest.raises(LinkError, match=saying) as first:
        bench.run(within)
    took = bench.clock.now() - began
    for _ in range(3):
        with pytest.raises(LinkError) as again:
            bench.sensor.samples()
        assert str(again.value) == str(first.value)
    return took


def test_an_unplugged_board_is_an_error_that_stays(bench):
    bench.unplug()
    assert failing(bench, "is gone: the other end has closed") < 0.02


def test_a_board_that_falls_silent_is_an_error(bench):
    bench.board.silent = True
    assert failing(bench, "sent no valid line") == pytest.approx(0.5, abs=0.02)


def test_a_restart_is_an_error(bench):
    bench.run(1.5)
    bench.board.reboot()
    assert failing(bench, "its zero is void") < 0.33


@pytest.mark.parametrize("counts", [60, -60, 150, 1000, -4096, 2**28])
@pytest.mark.parametrize("turning", [False, True])
def test_a_jump_of_the_count_is_an_error(bench, counts, turning):
    if turning:
        began = bench.clock.now()
        bench.motion = lambda time: -np.sign(counts) * 15.0 * (time - began)
        bench.run(0.05)
        counts *= 4
    bench.board.jump(counts)
    assert failing(bench, "jumped") < 0.02
    assert bench.sensor._dropped == MAX_INCONSISTENT


def forged(change, at=50):
    """Let one line say something else, under a right checksum: what slips through the codec."""
    seen = [0]

    def garble(data):
        said = decode(data[:-1])
        seen[0] += isinstance(said, Reading)
        return encode(change(said)) if seen[0] == at else data

    return garble


@pytest.mark.parametrize(
    "change",
    [
        lambda said: said._replace(seq=said.seq + 500, t_us=said.t_us + 500_000),
        lambda said: said._replace(counts=said.counts + 60),
        lambda said: said._replace(counts=-(2**31)),
        lambda said: said._replace(seq=(said.seq + 1) % 65536),
        lambda said: said._replace(seq=(said.seq - 1) % 65536),
        lambda said: said._replace(seq=(said.seq + 30_000) % 65536),
        lambda said: said._replace(t_us=(said.t_us + 1_000) % 2**32),
        lambda said: said._replace(t_us=(said.t_us - 1_000) % 2**32),
        lambda said: said._replace(t_us=(said.t_us + 10**9) % 2**32),
    ],
)
def test_a_wrong_line_with_a_right_checksum_is_dropped_alone(bench, change):
    bench.garble = forged(change)
    samples = bench.run(0.2)
    assert len(samples) == 199
    assert all(sample.counts == 0 for sample in samples)
    assert np.max(np.diff([sample.time for sample in samples])) < 2.2e-3
    assert bench.sensor._dropped == 1
    assert [sample.missing for sample in samples if sample.missing] == [1]


def test_a_board_of_malformed_lines_gives_only_true_samples():
    bench = Bench(seed=3)
    bench.motion = swinging
    bench.sensor.connect()
    bench.board.malformed = 0.2
    samples = bench.run(20.0)
    assert bench.sensor.rejected > 2000
    assert 14_000 < len(samples) < 16_000
    for sample in samples:
        assert abs(sample.counts * RESOLUTION - swinging(sample.time - 0.001)) < 0.02
    # What is not given out is told as missing, the damaged lines at the very end apart.
    told = sum(sample.missing for sample in samples)
    assert told + len(samples) == pytest.approx(20_000, abs=25)


def test_a_link_that_cannot_be_opened_says_why():
    def nowhere():
        raise LinkError("there is no device /dev/ttyX; plug the board in")

    sensor = LineEncoder(nowhere, Bench().clock)
    with pytest.raises(LinkError, match="/dev/ttyX"):
        sensor.connect()
    with pytest.raises(LinkError, match="is not connected"):
        sensor.samples()
