"""The emulated KST server does what the real one was seen to do, its faults included."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.errors import LinkError
from tests.robots.kst.follower import HOME, Bench

HOME_LINE = b"0.0_0.4364_0.0_-1.3962_0.0_1.309_0.0_\n"
START, STOP, ASK = "startDirectServoJoints", "stopDirectServoJoints", "getJointsPositions"


def moved(command, q1):
    """Return a setpoint whose first joint is elsewhere."""
    return command + "_" + "".join(f"{value}_" for value in (q1, *HOME[1:]))


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def servo(bench):
    """A bench whose joint servo runs."""
    assert bench.say(START, wait=0.3) == b"done\n"
    assert bench.body.running
    return bench


def test_servo_is_acknowledged_before_it_exists_and_then_forgets_its_target(bench):
    assert bench.say(START, wait=0.001) == b"done\n"
    assert not bench.body.running
    assert bench.say(moved("jp", 0.3), wait=0.001) == b"done\n"
    bench.wait(0.5)
    assert bench.body.running
    assert bench.body.measured() == HOME
    # ... and follows those that come later; a reply tells the joints before the motion.
    assert bench.say(moved("jpJP", 0.3), wait=0.001) == HOME_LINE
    bench.wait(0.5)
    assert float(bench.say(ASK).split(b"_")[0]) == pytest.approx(0.3)


@pytest.mark.parametrize("command", ["doPTPinJS", START])
def test_main_thread_is_deaf_while_a_servo_runs(servo, command):
    assert servo.say(command, wait=0.5) == b""
    assert servo.say(moved("jp", 0.0)) == b"done\n"
    assert servo.say(STOP, wait=0.5) == b"done\n", "what waited has been erased"


TORQUES = b"0.0_-12.5_0.0_8.25_0.0_0.5_0.0_\n"
EXTERNAL = b"0.5_-1.25_1.0E-4_0.0_0.0_0.0_0.125_\n"


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        *((command, b"done\n") for command in ("blueOn", "blueOff", "jRelVel_0.1_")),
        *(("Torques_ext_J", EXTERNAL), ("Torques_m_J", TORQUES)),
        *((moved("jpExT", 0.0), EXTERNAL), (moved("jpMT", 0.0), TORQUES)),
        ("jRelVel_fast_", b"nak\n"),
        # Silent in the real server: unknown, or misspelt by a client.
        *((command, b"") for command in ("hello", "pin1", "DcSeCarW_1_2_")),
        ("startSmartImpedanceJoints_1.0_0.0_0.0_0.0_900_80_50_", b""),
    ],
)
def test_server_answers_from_joints_and_torques_and_is_silent_otherwise(bench, command, reply):
    assert bench.say(command) == reply
    assert bench.say(ASK) == HOME_LINE


def test_nan_of_c_kills_the_reader_and_leaves_the_servo_on(servo):
    assert servo.say(moved("jp", 0.2), wait=0.001) == b"done\n"
    for command in ("jp_nan_0_0_0_0_0_0_", ASK, STOP, "end", moved("jp", 0.0)):
        assert servo.say(command, wait=0.5) == b""
    assert servo.body.running
    assert not servo.server.ended
    assert servo.body.measured()[0] == pytest.approx(0.2)


def test_client_that_vanishes_leaves_the_servo_on_and_nobody_is_served_again(servo):
    servo.say(moved("jp", 0.2), wait=0.001)
    servo.gone = True
    servo.wait(5.0)
    assert servo.server.deserted
    assert servo.body.running
    assert servo.body.measured()[0] == pytest.approx(0.2)
    assert servo.say(ASK, STOP, "end", wait=1.0) == b""
    assert servo.body.running
    assert not servo.server.ended


COMMANDS = st.sampled_from(
    [START, STOP, "doPTPinJS", ASK, "jp_0.1_", "jpJP_NaN_", "jp_nan_", "end", "jRelVel_0.1_", ""]
)


@given(st.lists(st.one_of(COMMANDS.map(str.encode), st.binary(max_size=20)), max_size=60))
def test_nothing_that_a_client_sends_breaks_the_server(pieces):
    bench = Bench()
    for tick, data in enumerate(pieces, start=1):
        with suppress(LinkError):  # the server has ended
            bench.client.write(data + b"\n" * (tick % 3))
            bench.wait(0.001)
            answer = bench.client.read()
            assert not answer or answer.endswith(b"\n")
