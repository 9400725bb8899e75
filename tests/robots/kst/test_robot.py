"""The driver against the emulated server, in virtual time."""

import pytest

from equipoise.errors import LinkError
from equipoise.rig.plugins import Session
from equipoise.robots.kst.codec import numbers_reply
from equipoise.robots.kst.robot import KstRobot
from tests.robots.kst.follower import HOME, Bench


class Rig(Bench):
    """A bench with the driver at its end, counting what is opened."""

    def __init__(self, *, opens_after=0.0):
        super().__init__()
        self.told, self.opened, self.tried, self.opens_after = [], 0, 0, opens_after
        session = Session(self.clock, self.clock, notify=self.told.append)
        self.robot = KstRobot(self.open, session)

    def open(self):
        self.tried += 1
        if self.clock.now() < self.opens_after:
            raise LinkError("nobody listens")
        self.opened += 1
        return self.client

    def stream(self, duration, q=HOME, period=0.005):
        """Send one setpoint in each period, and return the replies."""
        replies, end = [], self.clock.now() + duration
        while self.clock.now() < end - 1e-9:
            self.robot.send(q)
            self.wait(period)
            replies += self.robot.replies()
        return replies


@pytest.fixture
def rig():
    rig = Rig()
    rig.robot.connect()
    return rig


@pytest.fixture
def streaming(rig):
    rig.robot.start()
    return rig


def off(value):
    return (value, *HOME[1:])


def latched(rig):
    """Whether nothing works any more, and nothing more is sent."""
    rig.wait(0.01)
    heard, robot = rig.heard, rig.robot
    calls = (robot.measured, robot.start, robot.replies, robot.stop, robot.connect)
    for call in (*calls, lambda: robot.send(HOME)):
        with pytest.raises(LinkError, match="E-stop|No servo runs|was closed|was used"):
            call()
    rig.wait(2.0)
    return rig.heard == heard and rig.opened == 1


def test_session_is_these_bytes_after_the_waits_that_the_server_requires(rig, monkeypatch):
    monkeypatch.setattr("equipoise.robots.kst.robot.TORQUE_EVERY", 2)
    rig.robot.start()
    rig.robot.send((0.005123456789, *HOME[1:]))
    rig.robot.send(HOME)
    rig.robot.stop()
    joints, torques = rig.robot.replies()
    rig.robot.measured()
    rig.robot.close()
    assert (joints.torque, torques.q, torques.torque) == (None, None, rig.body.external)
    home = b"0_0.4364_0_-1.3962_0_1.309_0_\n"
    assert rig.heard == (
        b"getJointsPositions\n"
        b"startDirectServoJoints\n"
        b"getJointsPositions\n"
        b"jpJP_0.00512345679_0.4364_0_-1.3962_0_1.309_0_\n"
        b"jpExT_" + home + b"stopDirectServoJoints\n"
        b"getJointsPositions\n"
        b"end\n"
    )
    times = dict[str, list[float]]()
    for now, data in rig.heard_at:
        times.setdefault(data.decode().strip().split("_")[0], []).append(now)
    (asked, again, last), (first,) = times["getJointsPositions"], times["jpJP"]
    (start,), (stop,) = times["startDirectServoJoints"], times["stopDirectServoJoints"]
    assert asked >= 1.0
    assert 0.5 <= again - start < 0.51
    assert again < first
    assert 0.5 <= stop - first < 0.51
    assert 0.3 <= last - stop < 0.31


def test_connect_waits_for_the_operator_with_instructions():
    rig = Rig(opens_after=30.0)
    rig.robot.connect()
    assert len(rig.told) == 1
    assert 31.0 <= rig.clock.now() < 33.0


def test_connect_gives_up_after_a_minute():
    rig = Rig(opens_after=1e9)
    with pytest.raises(LinkError, match="within 60 s: nobody listens"):
        rig.robot.connect()
    assert 60.0 <= rig.clock.now() < 62.0
    assert rig.tried == 61


# Whatever goes wrong ends the link for good.


@pytest.mark.parametrize(
    ("period", "saying", "within"),
    [(0.02, r"setpoint within 0\.1 s", 0.121), (0.0005, "20 setpoints wait", 0.021)],
)
def test_silence_ends_the_link(streaming, period, saying, within):
    streaming.stream(0.1)
    streaming.end.cut = True
    began = streaming.clock.now()
    with pytest.raises(LinkError, match=saying):
        streaming.stream(1.0, period=period)
    assert streaming.clock.now() - began <= within
    assert latched(streaming)


@pytest.mark.parametrize(("step", "believed"), [(0.24, True), (0.26, False), (-0.26, False)])
def test_joints_that_cannot_have_been_reached_are_not_believed(streaming, step, believed):
    streaming.client.cut = True
    streaming.robot.send(HOME)
    streaming.wait(0.05)  # 0.2 rad at 4 rad/s, and 0.05 rad of noise
    streaming.end.write(numbers_reply(off(step)))
    if believed:
        assert streaming.robot.replies()[0].q[0] == step
    else:
        with pytest.raises(LinkError, match=r"expected joints less than 0\.25 rad .* got 0\.26"):
            streaming.robot.replies()


@pytest.mark.parametrize("extra", [b"done\n", b"0.0_" * 8 + b"\n", b"\xff\n", b"0" * 1025])
def test_wrong_answer_ends_the_link(streaming, extra):
    streaming.robot.send(HOME)
    streaming.end.write(extra)
    with pytest.raises(LinkError, match="expected"):
        streaming.robot.replies()
    assert latched(streaming)


def test_closed_connection_ends_the_link_and_says_what_that_means(streaming):
    streaming.robot.send(off(0.01))
    streaming.wait(0.001)
    streaming.end.close()
    streaming.wait(0.1)
    with pytest.raises(LinkError, match=r"software cannot stop it: be ready at the E-stop"):
        streaming.stream(1.0)
    assert latched(streaming)
    assert streaming.body.running
    assert streaming.body.measured()[0] == pytest.approx(0.01, abs=1e-6)


def test_failed_link_still_says_goodbye_which_ends_the_servo(streaming):
    write = streaming.end.write
    streaming.end.write = lambda reply: write(b"nak\n")
    with pytest.raises(LinkError):
        streaming.stream(0.1)
    streaming.robot.close()
    assert streaming.server.ended
    streaming.wait(0.01)
    assert not streaming.body.running
