"""Robot and encoder of a bench in process: what is theirs alone, beyond the conformance suites."""

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.robots.kst import robot as kuka
from equipoise.robots.twin.robot import KEPT, TORQUE_EVERY, TwinEncoder, TwinRobot
from tests.rig.in_process import ARM, VirtualClock, stand
from tests.rig.model_robot import ModelRobot


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
def test_one_reply_in_ten_has_torques_as_those_of_kst_have():
    bench, clock = stand()
    robot = TwinRobot(bench, clock)
    robot.connect()
    robot.start()
    bench.touch((0.0, 0.0, -30.0))
    wait(clock, 0.2)
    for _ in range(TORQUE_EVERY):
        robot.send(robot.measured())
    wait(clock, 0.005)
    *others, reply = robot.replies()
    assert {other.torque for other in others} == {None}
    assert reply.q is None
    assert reply.torque[1] > 15.0
    assert kuka.TORQUE_EVERY == TORQUE_EVERY


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


@pytest.mark.compiled_only
def test_samples_that_nobody_reads_are_lost_and_told_as_missing():
    bench, clock = stand()
    encoder = TwinEncoder(bench, clock)
    encoder.connect()
    encoder.samples()
    wait(clock, 1e-3 * (KEPT + 100))
    samples = encoder.samples()
    assert [s.missing for s in samples[1:]] == [0] * (len(samples) - 1)
    assert len(samples) + samples[0].missing == KEPT + 100


@pytest.mark.compiled_only
def test_times_are_wrong_by_the_worlds_jitter_and_no_more():
    bench, clock = stand(encoder_jitter=0.0003)
    encoder = TwinEncoder(bench, clock)
    encoder.connect()
    wait(clock, 1.0)
    times = np.array([sample.time for sample in encoder.samples()])
    off = times - 1e-3 * np.round(1e3 * times)
    assert 0.00025 < np.abs(off).max() <= 0.0003


def test_the_model_is_where_it_was_sent_after_its_transport():
    clock = VirtualClock()
    robot = ModelRobot(ARM, clock, transport=0.010, round_trip=0.004)
    robot.connect()
    robot.start()
    home = np.array(ARM.home)
    robot.send(home + 0.1)
    told = []
    for _ in range(4):
        wait(clock, 0.004)
        told += [(reply.sent, reply.q) for reply in robot.replies()]
        robot.send(home + 0.1)
    assert told[0] == (0.0, ARM.home)
    assert told[1][1] == ARM.home  # half-way is 6 ms after the first was sent
    assert told[2][1] == pytest.approx(home + 0.1)  # and here 10 ms
