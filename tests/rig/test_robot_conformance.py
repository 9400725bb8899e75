"""Every robot of this package passes the suite that a guest's robot passes.

Another one adds a class that says how to make it.
"""

import numpy as np
import pytest

from equipoise.robots.kst.robot import KstRobot
from equipoise.testing import RobotConformance
from tests.rig import in_process
from tests.robots.kst.follower import Bench


class TestKst(RobotConformance):
    def make(self, **options):
        bench = Bench(**options)
        return KstRobot(lambda: bench.client, bench.clock), bench.clock


class TestKstOverASlowLink(TestKst):
    def make(self):
        return super().make(delay=0.008)


class TestTwin(RobotConformance):
    make = staticmethod(in_process.twin_robot)


@pytest.mark.parametrize("name", [name for name in dir(RobotConformance) if "test_" in name])
def test_a_robot_that_does_nothing_passes_no_test(name):
    class Still:
        """A robot that takes everything and does nothing."""

        joints = 7
        connect = start = stop = close = lambda self: None
        measured = lambda self: np.random.default_rng().standard_normal(7)  # noqa: E731
        send = lambda self, q: None  # noqa: E731

    class Suite(RobotConformance):
        def make(self):
            return Still(), in_process.VirtualClock()

    with pytest.raises((AssertionError, AttributeError)):
        getattr(Suite(), name)()
