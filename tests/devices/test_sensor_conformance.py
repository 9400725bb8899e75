"""What every angle sensor must do, whatever is behind it.

A factory returns a `Spindle`: the sensor, its clock, and what moves or harms it. One line in
`SPINDLES` adds another kind.
"""

import itertools
from collections.abc import Callable
from math import pi
from typing import NamedTuple

import pytest

from equipoise.devices.interfaces import AngleSensor, Clock
from equipoise.errors import LinkError
from tests.devices import in_process
from tests.devices.encoder.rig import Bench


class Spindle(NamedTuple):
    """A sensor, and the world on its other side."""

    sensor: AngleSensor
    clock: Clock
    turn: Callable[[Callable[[float], float]], None]
    """Let theta be a function of the time from now on [rad]; it is zero until then."""
    press: Callable[[], None] | None
    """Press the button and let it go; none where there is none."""
    unplug: Callable[[], None] | None
    """Cut the link; none where there is none."""
    age: float
    """No sample is older when it is read, beyond the time between two looks [s]."""


def board_behind_a_pipe():
    bench = Bench(drift=5e-5, offset_us=2**32 - 500_000, expected=8192)

    def press():
        bench.board.press()
        bench.board.let_go()

    def turn(motion):
        bench.motion = motion

    return Spindle(bench.sensor, bench.clock, turn, press, bench.unplug, 0.005)


SPINDLES = {
    "E-line board": board_behind_a_pipe,
    "twin": lambda: Spindle(*in_process.twin_encoder()),
}


@pytest.fixture(params=SPINDLES)
def fresh(request):
    return SPINDLES[request.param]()


@pytest.fixture
def spindle(fresh):
    fresh.sensor.connect()
    yield fresh
    fresh.sensor.close()


def watch(spindle, seconds, every=0.005):
    """Let time pass; return the samples, and when each was read."""
    samples, read = [], []
    until = spindle.clock.now() + seconds
    while spindle.clock.now() < until - 1e-9:
        spindle.clock.wait_until(spindle.clock.now() + every)
        new = spindle.sensor.samples()
        samples += new
        read += [spindle.clock.now()] * len(new)
    return samples, read


def test_it_is_an_angle_sensor(fresh):
    assert isinstance(fresh.sensor, AngleSensor)


def test_once_connected_it_has_a_sample_at_once(spindle):
    assert len(spindle.sensor.samples()) > 0


def test_it_has_whole_counts_per_revolution(spindle):
    assert isinstance(spindle.sensor.counts_per_rev, int)
    assert spindle.sensor.counts_per_rev > 0


def test_times_are_the_clocks_and_increase(spindle):
    samples, read = watch(spindle, 1.0)
    assert len(samples) > 100
    times = [sample.time for sample in samples]
    assert all(later > earlier for earlier, later in itertools.pairwise(times))
    for time, now in zip(times, read, strict=True):
        assert -0.001 <= now - time <= spindle.age + 0.005


def test_no_sample_is_given_twice_and_reading_does_not_wait(spindle):
    watch(spindle, 0.1)
    before = spindle.clock.now()
    assert spindle.sensor.samples() == []
    assert spindle.clock.now() == before


def test_counts_grow_with_theta_by_their_number_per_revolution(spindle):
    start = watch(spindle, 0.1)[0][-1].counts
    began = spindle.clock.now()
    spindle.turn(lambda time: min(5.0 * (time - began), pi / 2.0))
    turned = watch(spindle, 0.5)[0]
    counts = [sample.counts for sample in turned]
    assert counts == sorted(counts)
    assert counts[-1] - start == pytest.approx(spindle.sensor.counts_per_rev / 4, abs=1)
    spindle.turn(lambda time: max(pi / 2.0 - 5.0 * (time - began - 0.5), -pi / 2.0))
    assert watch(spindle, 0.8)[0][-1].counts - start == pytest.approx(
        -spindle.sensor.counts_per_rev / 4, abs=1
    )


def test_each_count_is_that_of_its_time(spindle):
    start = watch(spindle, 0.1)[0][-1].counts
    began = spindle.clock.now()
    spindle.turn(lambda time: 10.0 * (time - began))
    step = 2.0 * pi / spindle.sensor.counts_per_rev
    for sample in watch(spindle, 0.5)[0][20:]:
        theta = (sample.counts - start) * step
        assert abs(theta - 10.0 * (sample.time - began)) < 10.0 * spindle.age + step


def test_nothing_is_missing_or_illegal_where_nothing_happens(spindle):
    samples, _ = watch(spindle, 0.5)
    assert sum(sample.missing for sample in samples) == 0
    assert not any(sample.illegal or sample.pressed for sample in samples)


def test_a_press_is_told_once(spindle):
    if spindle.press is None:
        pytest.skip("it has no button")
    watch(spindle, 0.05)
    spindle.press()
    assert sum(sample.pressed for sample in watch(spindle, 0.2)[0]) == 1


def test_a_cut_link_is_an_error_that_stays(spindle):
    if spindle.unplug is None:
        pytest.skip("it has no link")
    spindle.unplug()
    with pytest.raises(LinkError):
        watch(spindle, 1.0)
    with pytest.raises(LinkError):
        spindle.sensor.samples()


def test_before_it_is_connected_and_after_it_is_closed_it_gives_nothing(fresh):
    with pytest.raises(LinkError):
        fresh.sensor.samples()
    fresh.sensor.connect()
    fresh.sensor.close()
    fresh.sensor.close()
    with pytest.raises(LinkError):
        fresh.sensor.samples()
