"""Robot and encoder of a bench in process: what is theirs alone, beyond the conformance suites."""

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.robots.twin import TwinEncoder, TwinRobot
from tests.rig.in_process import stand


def wait(clock, seconds):
    clock.wait_until(clock.now() + seconds)


@pytest.mark.compiled_only
def test_a_reply_takes_its_age_and_tells_the_joints_of_half_way():
    bench, clock = stand(reply_age=0.006, joint_noise=0.0)
    robot = TwinRobot(bench, clock)
    robot.connect()
    robot.start()
    at = {}
    bench.watch(lambda: at.update({round(1e3 * bench.now): bench.body.measured()}))
    q = robot.measured()
    for _ in range(40):
        q[0] += 0.002
        robot.send(q)
        sent = clock.now()
        wait(clock, 0.005)
        assert robot.replies() == []
        wait(clock, 0.001)
        (reply,) = robot.replies()
        assert reply.sent == sent
        assert reply.received == pytest.approx(sent + 0.006)
        assert reply.q == (None if reply.torque else at[round(1e3 * sent) + 3])


@pytest.mark.compiled_only
def test_an_arm_that_was_stopped_does_not_start():
    bench, clock = stand()
    robot = TwinRobot(bench, clock)
    robot.connect()
    bench.body.stop("emergency stop")
    with pytest.raises(LinkError, match="emergency stop"):
        robot.start()
    bench.body.set_free()
    robot.start()


@pytest.mark.compiled_only
def test_counts_are_those_of_the_pendulum():
    bench, clock = stand()
    encoder = TwinEncoder(bench, clock)
    encoder.connect()
    start = bench.theta
    bench.lift(side="back")
    wait(clock, 4.0)
    counts = encoder.samples()[-1].counts
    measured = counts * 2 * np.pi / encoder.counts_per_rev
    assert abs(bench.theta - start) > 3.0
    assert measured == pytest.approx(bench.theta - start, abs=5e-3)
