"""The emulated KST server does what the real one was seen to do, its faults included."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equipoise.errors import LinkError
from equipoise.robots.kst.codec import numbers_reply
from equipoise.robots.kst.server_emulator import Faults, KstServer
from tests.robots.kst.follower import HOME, SPEEDS, Bench, Follower

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


# At rest.


def test_there_is_no_banner(bench):
    bench.wait(2.0)
    assert bench.client.read() == b""


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("getJointsPositions", HOME_LINE),
        ("getJointsPositions\r", HOME_LINE),
        ("jRelVel_0.1_", b"done\n"),
        ("jRelVel_0.1", b"done\n"),
        ("jRelVel_x_", b"nak\n"),
        ("jRelVel", b"nak\n"),
        (line("jp", HOME), b"done\n"),
        (line("jp", HOME) + "9.0_9.0_", b"done\n"),
        (line("jpJP", HOME), HOME_LINE),
        (line("jpExT", HOME), b"0.5_-1.25_1.0E-4_0.0_0.0_0.0_0.125_\n"),
        (line("jpMT", HOME), b"0.0_-12.5_0.0_8.25_0.0_0.5_0.0_\n"),
        (line("jpEEfP", HOME), b"400.5_0.0_600.25_3.0_0.0_-3.0_\n"),
        (line("jpEEfFrelEEF", HOME), b"0.0_0.0_0.0_\n"),
        (line("jf", HOME), b""),
        ("Torques_ext_J", b"0.5_-1.25_1.0E-4_0.0_0.0_0.0_0.125_\n"),
        ("Torques_m_J", b"0.0_-12.5_0.0_8.25_0.0_0.5_0.0_\n"),
        ("Eef_pos", b"400.5_0.0_600.25_3.0_0.0_-3.0_\n"),
        ("Eef_force", b"0.0_0.0_0.0_\n"),
        ("Eef_moment", b"0.0_0.0_0.0_\n"),
        ("Eef_pos_", b""),
        ("blueOn", b"done\n"),
        ("blueOff", b"done\n"),
        ("pin1on", b"done\n"),
        ("pin11off", b"done\n"),
        ("getPin3", b"1\n\n"),
        ("getPin10", b"1\n\n"),
        ("handGuiding", b"done\n"),
        ("preciseHandGuiding1_1_2_3_4_", b"done\n"),
        ("cArtixanPosition_1_2_3_0_0_0_", b"done\n"),
        ("TFtrans_0_0_30_0_0_0_", b"done\n"),
        ("TFtrans_0_0_x_0_0_0", b"nak\n"),
        ("TFtrans_0_0_0_0_0_0_0_", b"nak\n"),
        (STOP, b"done\n"),
        ("hello", b""),
        ("DcSeCarW_1_2_3_0_0_0_", b""),
        ("stVelDcJoint_", b""),
        ("velJDC_0.1_0_0_0_0_0_0_", b""),
        ("startSmartImpedanceJoints_1_0_0_0_1_1_1_", b""),
        ("doPTP!inJS_1_0_1_", b""),
        ("jpXX_0_", b""),
    ],
)
def test_command_has_its_reply_and_the_next_one_works(bench, command, reply):
    assert bench.say(command) == reply
    assert bench.say("getJointsPositions") == HOME_LINE
    assert not bench.server.closed


def test_two_line_ends_are_harmless(bench):
    assert bench.say(line("jp", HOME), "") == b"done\n"
    assert bench.say("jRelVel_0.1_", "") == b"done\n"


def test_tool_of_wrong_size_ends_the_program(bench):
    assert bench.say("TFtrans_1_2_3_") == b"nak\n"
    assert bench.server.ended
    with pytest.raises(LinkError):
        bench.say("getJointsPositions")


def test_two_commands_of_the_reader_are_answered_in_order(bench):
    assert bench.say("getJointsPositions", line("jp", HOME)) == HOME_LINE + b"done\n"


def test_commands_of_reader_and_main_thread_are_answered_in_order(bench):
    assert bench.say("getJointsPositions", "jRelVel_0.1_") == HOME_LINE + b"done\n"


def test_of_two_commands_of_the_main_thread_one_is_answered(bench):
    assert bench.say("jRelVel_0.1_", "Torques_m_J") == b"done\n"
    assert bench.say("jRelVel_0.1_") == b"done\n"


def test_command_that_comes_right_after_an_acknowledgement_is_erased(bench):
    bench.client.write(b"jRelVel_0.1_\n")
    bench.wait(0.001)
    assert bench.client.read() == b"done\n"
    bench.client.write(b"jRelVel_0.2_\n")
    bench.wait(0.0001)
    assert bench.say("jRelVel_0.2_") == b"done\n"


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


@pytest.mark.parametrize(
    "command", ["Torques_ext_J", "Torques_m_J", "Eef_pos", "jRelVel_0.1_", "doPTPinJS", START]
)
def test_main_thread_is_deaf_while_a_servo_runs(servo, command):
    assert servo.say(command, wait=0.5) == b""
    assert servo.say(line("jp", HOME)) == b"done\n"
    assert servo.say(STOP, wait=0.5) == b"done\n", "what waited has been erased"


def test_command_between_stop_and_the_end_of_the_servo_waits_for_it(servo):
    servo.client.write(f"{STOP}\nTorques_m_J\n".encode())
    servo.wait(0.001)
    assert servo.client.read() == b"done\n"
    assert servo.body.running
    servo.wait(0.01)
    assert not servo.body.running
    assert servo.client.read() == numbers_reply(servo.body.torques(False))


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


def test_numbers_before_one_that_cannot_be_read_are_obeyed(servo):
    servo.say("jf_0.3_nan_0.2_")
    assert servo.body.targets[-1] == (0.3, *HOME[1:])


def test_nan_of_java_becomes_the_target(servo):
    assert servo.say(line("jpJP", ["NaN", *HOME[1:]])) == HOME_LINE
    assert math.isnan(servo.body.targets[-1][0])


def test_endless_line_is_never_answered(servo):
    assert servo.say("x" * 5000) == b""
    assert servo.say("getJointsPositions") == b""
    assert servo.body.running


def test_client_that_vanishes_leaves_the_servo_on_and_nobody_is_served_again(servo):
    servo.say(line("jp", moved(q1=0.2)), wait=0.001)
    servo.server.vanished(servo.clock.now())
    servo.wait(5.0)
    assert servo.body.running
    assert servo.body.measured()[0] == pytest.approx(0.2)
    assert servo.say("getJointsPositions", STOP, "end", wait=1.0) == b""
    assert servo.body.running
    assert not servo.server.closed


def test_silent_client_is_waited_for(servo):
    servo.wait(5.0)
    assert servo.body.running
    assert servo.say(line("jpJP", HOME)) == HOME_LINE


def test_end_has_no_reply_ends_the_servo_and_closes(servo):
    servo.client.write(b"end\n")
    servo.wait(0.01)
    assert servo.server.ended
    assert not servo.body.running
    with pytest.raises(LinkError):
        servo.client.read()


# Motions.


def test_motion_is_acknowledged_twice(bench):
    assert bench.say("jRelVel_0.5_") == b"done\n"
    assert bench.say(line("jp", moved(q1=0.2))) == b"done\n"
    began = bench.clock.now()
    assert bench.say("doPTPinJS", wait=0.019) == b"done\n"
    bench.client.write(line("jp", moved(q1=-0.5)).encode() + b"\n")
    while not (more := bench.client.read()):
        bench.wait(0.001)
    assert more == b"done\n", "the setpoint's answer, which is not the end of the motion"
    while not (more := bench.client.read()):
        bench.wait(0.001)
    assert more == b"done\n"
    assert bench.body.measured() == pytest.approx(moved(q1=0.2), abs=1e-3)
    assert not bench.body.running
    fastest = max(np.diff([q[0] for q in bench.body.targets])) / 0.001
    assert fastest == pytest.approx(0.5 * SPEEDS[0], rel=0.01)
    assert bench.clock.now() - began > 1.875 * 0.2 / (0.5 * SPEEDS[0])


def test_motion_to_where_the_arm_is_ends_20_ms_later_at_the_earliest(bench):
    bench.say("jRelVel_1_")
    bench.say(line("jp", HOME))
    assert bench.say("doPTPinJS", wait=0.019) == b"done\n"
    bench.wait(0.01)
    assert bench.client.read() == b"done\n"


def test_command_for_the_main_thread_is_erased_by_the_end_of_a_motion(bench):
    bench.say("jRelVel_1_")
    bench.say(line("jp", HOME))
    assert bench.say("doPTPinJS", "jRelVel_0.5_", wait=0.01) == b"done\n"
    bench.say("jRelVel_0.5_", wait=0.5)
    assert bench.client.read() == b""
    assert bench.say("jRelVel_0.5_") == b"done\n"


@pytest.mark.parametrize(
    "before",
    [
        (),
        ("jRelVel_0_",),
        ("jRelVel_1.5_",),
        ("jRelVel_0.1_", line("jp", ["NaN", *HOME[1:]])),
    ],
)
def test_motion_that_cannot_be_planned_is_refused_after_its_acknowledgement(bench, before):
    for command in before:
        assert bench.say(command) == b"done\n"
    assert bench.say("doPTPinJS") == b"done\nnak\n"


def test_motion_that_does_not_arrive_is_refused_in_the_end(bench):
    bench.body.frozen = True
    bench.say("jRelVel_0.5_")
    bench.say(line("jp", moved(q1=0.2)))
    assert bench.say("doPTPinJS", wait=4.0) == b"done\nnak\n"


def test_motion_goes_on_when_its_client_vanishes(bench):
    bench.say("jRelVel_0.5_")
    bench.say(line("jp", moved(q1=0.2)))
    bench.say("doPTPinJS", wait=0.05)
    bench.server.vanished(bench.clock.now())
    bench.wait(3.0)
    assert bench.body.measured()[0] == pytest.approx(0.2, abs=1e-3)


def test_cartesian_motion_is_refused_after_its_acknowledgement(bench):
    assert bench.say("doPTPinCS") == b"done\nnak\n"


# Other servos.


def test_cartesian_servo_answers_and_holds(bench):
    assert bench.say("stDcEEf_", wait=0.3) == b"done\n"
    assert bench.body.running
    target = "_400_0_600_3_0_-3_"
    assert bench.say("DcSeCar" + target) == b""
    assert bench.say("DcSeCarJP" + target) == HOME_LINE
    assert bench.say("DcSeCarExT" + target).startswith(b"0.5_")
    assert bench.say("DcSeCarMT" + target).startswith(b"0.0_-12.5_")
    assert bench.say("DcSeCarEEfP" + target).startswith(b"400.5_")
    assert bench.say("DcSeCarEEfFrelEEF" + target) == b"0.0_0.0_0.0_\n"
    assert bench.body.measured() == HOME
    assert bench.say(STOP) == b"done\n"
    assert not bench.body.running


def test_cartesian_target_that_cannot_be_read_ends_the_servo(bench):
    bench.say("stDcEEf_", wait=0.3)
    assert bench.say("DcSeCarJP_400_nan_") == HOME_LINE
    assert not bench.body.running


def test_seventh_number_of_a_cartesian_target_hangs_the_reader(bench):
    bench.say("stDcEEf_", wait=0.3)
    assert bench.say(line("DcSeCarJP", [0.0] * 7)) == b""
    assert bench.say("getJointsPositions") == b""
    assert bench.body.running


def test_impedance_servo_is_acknowledged_again_when_it_ends(bench):
    start = "startSmartImpedneceJoints_1_0_0_0_1000_100_10_"
    assert bench.say(start, wait=0.3) == b"done\n"
    # Its first joint keeps the target of old, which is zero on a new server.
    assert bench.body.targets[-1] == HOME
    assert bench.say(line("jp", moved(q2=0.5)), wait=0.3) == b"done\n"
    assert bench.body.measured()[1] == pytest.approx(0.5)
    assert bench.say(STOP, wait=0.3) == b"done\ndone\n"
    assert bench.say(start.replace("1000", "x"), wait=0.3) == b"nak\n"


# Faults on top.


def test_answers_come_late_and_in_order():
    bench = Bench(faults=Faults(delay=0.02, jitter=0.03))
    came = []
    for i in range(50):
        bench.client.write((line("jpJP", HOME) if i % 2 else line("jp", HOME)).encode() + b"\n")
        bench.wait(0.005)
        came.append((bench.clock.now(), bench.client.read()))
    bench.wait(0.1)
    stream = b"".join(data for _, data in came) + bench.client.read()
    assert stream == (b"done\n" + HOME_LINE) * 25
    assert not any(data for time, data in came if time <= 0.02)


def test_faults_are_the_same_each_time():
    def heard():
        bench = Bench(faults=Faults(drop=0.5, jitter=0.01))
        return [bench.say("getJointsPositions", wait=0.003) for _ in range(50)]

    first = heard()
    assert first == heard()
    assert 5 < sum(not reply for reply in first) < 45


def test_dropped_answer_was_obeyed(servo):
    servo.server.faults = Faults(drop=1.0)
    assert servo.say(line("jpJP", moved(q1=0.1)), wait=0.2) == b""
    assert servo.body.measured()[0] == pytest.approx(0.1)


def test_refusals_are_nak(servo):
    servo.server.faults = Faults(refuse=1.0)
    assert servo.say(line("jpJP", HOME)) == b"nak\n"


def test_deaf_server_obeys_nothing_and_the_servo_goes_on(servo):
    servo.server.faults = Faults(deaf=True)
    assert servo.say(line("jpJP", moved(q1=0.1)), STOP, wait=0.2) == b""
    assert servo.body.measured() == HOME
    assert servo.body.running
    servo.server.faults = replace(servo.server.faults, deaf=False)
    assert servo.say("getJointsPositions") == HOME_LINE


def test_connection_that_is_cut_leaves_the_servo_on(servo):
    servo.say(line("jpJP", moved(q1=0.1)), wait=0.001)
    servo.server.faults = Faults(close=True)
    servo.wait(0.2)
    with pytest.raises(LinkError):
        servo.client.read()
    assert servo.body.running
    assert servo.body.measured()[0] == pytest.approx(0.1)


COMMANDS = st.sampled_from(
    [START, STOP, "stDcEEf_", "jRelVel_0.5_", "doPTPinJS", "getJointsPositions",
     "jp_0.1_", "jpJP_NaN_", "jp_nan_", "DcSeCarJP_1_", "Eef_pos", "TFtrans_1_", "end", ""]
)  # fmt: skip


@settings(max_examples=50)
@given(st.lists(st.one_of(COMMANDS.map(str.encode), st.binary(max_size=20)), max_size=60))
def test_nothing_that_a_client_sends_breaks_the_server(said):
    body = Follower()
    server = KstServer(body, SPEEDS)
    for tick, data in enumerate(said, start=1):
        server.feed(data + b"\n" * (tick % 3), 0.001 * tick)
        for segment in server.advance(0.001 * tick):
            assert segment.endswith(b"\n")
