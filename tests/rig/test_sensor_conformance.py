"""Every angle sensor of this package passes the suite that a guest's sensor passes."""

from equipoise.testing import SensorConformance, Spindle
from tests.rig import in_process
from tests.robots.encoder.rig import Bench


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
