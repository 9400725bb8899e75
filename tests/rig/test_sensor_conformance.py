"""Every angle sensor of this package passes one suite."""

from collections.abc import Callable
from itertools import pairwise
from math import pi
from typing import Any, NamedTuple

import pytest

from equipoise.errors import LinkError
from equipoise.rig.interfaces import AngleSensor, Clock
from tests.rig import in_process
from tests.robots.encoder.rig import Bench


class Spindle(NamedTuple):
    """Unconnected angle sensor with controls of its spindle, button and link."""

    sensor: AngleSensor
    clock: Clock
    turn: Callable[[Callable[[float], float]], None]
    """Sets theta [rad] as a function of time from now on; theta is zero before."""
    press: Callable[[], None]
    unplug: Callable[[], None] | None
    """Cuts the link; None without a link."""
    age: float
    """Maximum age of a sample when read, in addition to the read interval [s]."""

    def watch(self, seconds: float) -> tuple[list[Any], list[float]]:
        """Wait [s]; return the samples, and when each was read [s]."""
        samples, read = [], []
        until = self.clock.now() + seconds
        while self.clock.now() < until - 1e-9:
            self.clock.wait_until(self.clock.now() + 0.005)
            new = self.sensor.samples()
            samples += new
            read += [self.clock.now()] * len(new)
        return samples, read


class SensorConformance:
    """Tests of an `AngleSensor`."""

    def make(self) -> Spindle:
        """Return a new sensor at rest, not connected, with its controls."""
        raise NotImplementedError

    def connected(self) -> Spindle:
        """Return a new connected sensor."""
        spindle = self.make()
        spindle.sensor.connect()
        return spindle

    def test_it_is_an_angle_sensor_that_gives_nothing_unless_connected(self):
        sensor = self.make().sensor
        assert isinstance(sensor, AngleSensor)
        with pytest.raises(LinkError):
            sensor.samples()
        sensor.connect()
        assert sensor.samples(), "a connected sensor has no sample at once"
        assert sensor.counts_per_rev > 0
        assert sensor.description
        sensor.close()
        sensor.close()
        with pytest.raises(LinkError):
            sensor.samples()

    def test_times_are_the_clocks_and_increase(self):
        spindle = self.connected()
        samples, read = spindle.watch(1.0)
        assert len(samples) > 100
        assert all(b.time > a.time for a, b in pairwise(samples))
        ages = [now - sample.time for sample, now in zip(samples, read, strict=True)]
        assert min(ages) >= -0.001
        assert max(ages) <= spindle.age + 0.005
        assert not any(s.missing or s.illegal or s.pressed for s in samples)
        assert spindle.sensor.rejected == 0
        before = spindle.clock.now()
        assert spindle.sensor.samples() == [], "a sample was given twice"
        assert spindle.clock.now() - before < 1e-3, "reading takes time"

    def test_counts_grow_with_theta_by_their_number_per_revolution(self):
        spindle = self.connected()
        start, quarter = spindle.watch(0.1)[0][-1].counts, spindle.sensor.counts_per_rev / 4
        began = spindle.clock.now()
        spindle.turn(lambda time: min(5.0 * (time - began), pi / 2.0))
        counts = [sample.counts - start for sample in spindle.watch(0.5)[0]]
        assert counts == sorted(counts)
        assert abs(counts[-1] - quarter) <= 1
        spindle.turn(lambda time: max(pi / 2.0 - 5.0 * (time - began - 0.5), -pi / 2.0))
        assert abs(spindle.watch(0.8)[0][-1].counts - start + quarter) <= 1

    def test_each_count_is_that_of_its_time(self):
        spindle = self.connected()
        start = spindle.watch(0.1)[0][-1].counts
        began = spindle.clock.now()
        spindle.turn(lambda time: 10.0 * (time - began))
        step = 2.0 * pi / spindle.sensor.counts_per_rev
        for sample in spindle.watch(0.5)[0][20:]:
            error = abs((sample.counts - start) * step - 10.0 * (sample.time - began))
            assert error < 10.0 * spindle.age + step

    def test_a_press_is_reported_once(self):
        spindle = self.connected()
        spindle.watch(0.05)
        spindle.press()
        assert sum(sample.pressed for sample in spindle.watch(0.2)[0]) == 1

    def test_a_cut_link_is_an_error_that_stays(self):
        spindle = self.connected()
        if spindle.unplug is not None:
            spindle.unplug()
            with pytest.raises(LinkError):
                spindle.watch(1.0)
            with pytest.raises(LinkError):
                spindle.sensor.samples()


class TestBoardBehindAPipe(SensorConformance):
    def make(self):
        bench = Bench(drift=5e-5, offset_us=2**32 - 500_000, expected=8192)

        def press():
            bench.board.press()
            bench.board.press(False)

        def turn(motion):
            bench.motion = motion

        return Spindle(bench.sensor, bench.clock, turn, press, bench.unplug, 0.005)


class TestTwin(SensorConformance):
    def make(self):
        return Spindle(*in_process.twin_encoder())
