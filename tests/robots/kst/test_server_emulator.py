"""The emulated KST server does what the real one was seen to do, its faults included."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equipoise.errors import LinkError
from equipoise.robots.kst.server_emulator import Faults, KstServer
from tests.robots.kst.follower import HOME, Bench, Follower

HOME_LINE = b"0.0_0.4364_0.0_-1.3962_0.0_1.309_0.0_\n"
START = "startDirectServoJoints"
STOP = "stopDirectServoJoints"


def line(command, values):
    return command + "_" + "".join(f"{value}_" for value in values)


def moved(**joints):
    q = list(HOME)
    for name, value in joints.items():
        q[int(name[1:]) - 1] = value
    return q


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def servo(bench):
    """A bench whose joint servo runs."""
    assert bench.say(START, wait=0.3) == b"done\n"
    assert bench.body.running
    return bench


# The joint servo.


def test_servo_is_acknowledged_before_it_exists_and_then_forgets_its_target(bench):
    bench.client.write(f"{START}\n".encode())
    bench.wait(0.001)
    assert bench.client.read() == b"done\n"
    assert not bench.body.running
    bench.client.write(line("jp", moved(q1=0.3)).encode() + b"\n")
    bench.wait(0.001)
    assert bench.client.read() == b"done\n"
    bench.wait(0.5)
    assert bench.body.running
    assert bench.body.measured() == HOME
    bench.say(line("jp", moved(q1=0.3)), wait=0.5)
    assert bench.body.measured()[0] == pytest.approx(0.3)


def test_servo_follows_setpoints_and_tells_the_measured_joints(servo):
    reply = servo.say(line("jpJP", moved(q1=0.005)), wait=0.001)
    assert reply == HOME_LINE, "the arm has not moved yet when the setpoint is answered"
    servo.wait(0.1)
    q1 = float(servo.say("getJointsPositions").split(b"_")[0])
    assert q1 == pytest.approx(0.005, abs=1e-6)


def test_one_number_is_accepted_and_changes_the_first_joint_only(servo):
    assert servo.say("jp_0.1_", wait=0.3) == b"done\n"
    assert servo.body.targets[-1] == (0.1, *HOME[1:])


@pytest.mark.parametrize("command", ["doPTPinJS", START])
def test_main_thread_is_deaf_while_a_servo_runs(servo, command):
    assert servo.say(command, wait=0.5) == b""
    assert servo.say(line("jp", HOME)) == b"done\n"
    assert servo.say(STOP, wait=0.5) == b"done\n", "what waited has been erased"


def test_stop_is_acknowledged_before_the_servo_ends(servo):
    servo.client.write(f"{STOP}\n".encode())
    servo.wait(0.001)
    assert servo.client.read() == b"done\n"
    assert servo.body.running
    servo.wait(0.01)
    assert not servo.body.running
    assert not servo.server.busy


def test_nan_of_c_kills_the_reader_and_leaves_the_servo_on(servo):
    assert servo.say(line("jp", moved(q1=0.2)), wait=0.001) == b"done\n"
    assert servo.say("jp_nan_0_0_0_0_0_0_") == b""
    for command in ("getJointsPositions", STOP, "end", line("jp", HOME)):
        assert servo.say(command, wait=0.5) == b""
    assert servo.body.running
    assert not servo.server.closed
    assert servo.body.measured()[0] == pytest.approx(0.2)


def test_nan_of_java_becomes_the_target(servo):
    assert servo.say(line("jpJP", ["NaN", *HOME[1:]])) == HOME_LINE
    assert math.isnan(servo.body.targets[-1][0])


def test_client_that_vanishes_leaves_the_servo_on_and_nobody_is_served_again(servo):
    servo.say(line("jp", moved(q1=0.2)), wait=0.001)
    servo.server.vanished(servo.clock.now())
    servo.wait(5.0)
    assert servo.body.running
    assert servo.body.measured()[0] == pytest.approx(0.2)
    assert servo.say("getJointsPositions", STOP, "end", wait=1.0) == b""
    assert servo.body.running
    assert not servo.server.closed


def test_end_has_no_reply_ends_the_servo_and_closes(servo):
    servo.client.write(b"end\n")
    servo.wait(0.01)
    assert servo.server.ended
    assert not servo.body.running
    with pytest.raises(LinkError):
        servo.client.read()


# Faults on top.


def test_answers_come_late():
    bench = Bench(faults=Faults(delay=0.02))
    assert bench.say("getJointsPositions", wait=0.019) == b""
    bench.wait(0.002)
    assert bench.client.read() == HOME_LINE


def test_dropped_answer_was_obeyed(servo):
    servo.server.faults = Faults(drop=1.0)
    assert servo.say(line("jpJP", moved(q1=0.1)), wait=0.2) == b""
    assert servo.body.measured()[0] == pytest.approx(0.1)


def test_refusals_are_nak(servo):
    servo.server.faults = Faults(refuse=1.0)
    assert servo.say(line("jpJP", HOME)) == b"nak\n"


def test_connection_that_is_cut_leaves_the_servo_on(servo):
    servo.say(line("jpJP", moved(q1=0.1)), wait=0.001)
    servo.server.faults = Faults(close=True)
    servo.wait(0.2)
    with pytest.raises(LinkError):
        servo.client.read()
    assert servo.body.running
    assert servo.body.measured()[0] == pytest.approx(0.1)


COMMANDS = st.sampled_from(
    [START, STOP, "doPTPinJS", "getJointsPositions", "jp_0.1_", "jpJP_NaN_", "jp_nan_", "end", ""]
)  # fmt: skip


@settings(max_examples=50)
@given(st.lists(st.one_of(COMMANDS.map(str.encode), st.binary(max_size=20)), max_size=60))
def test_nothing_that_a_client_sends_breaks_the_server(said):
    body = Follower()
    server = KstServer(body)
    for tick, data in enumerate(said, start=1):
        server.feed(data + b"\n" * (tick % 3), 0.001 * tick)
        for segment in server.advance(0.001 * tick):
            assert segment.endswith(b"\n")
