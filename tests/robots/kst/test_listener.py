"""The emulated server on a real port."""

import socket
import struct
import threading
import time

import pytest

from equipoise.errors import LinkError, OutsideError
from equipoise.rig.clocks import TICK, SystemClock, VirtualClock
from equipoise.robots.kst.listener import serve
from equipoise.robots.kst.robot import KstRobot, dial
from equipoise.robots.kst.server_emulator import KstServer
from tests.robots.kst.follower import HOME, SPEEDS, Follower


class Served:
    """A follower behind a server on a local port, in a thread, until the test ends."""

    def __init__(self):
        self.body, self.clock, self.stop = Follower(), SystemClock(), threading.Event()
        self.server = KstServer(self.body, SPEEDS)
        self.time, ready, ports = self.clock.now(), threading.Event(), []

        def listening(port):
            ports.append(port)
            ready.set()

        def run():
            address = "127.0.0.1", 0
            serve(self.server, address, self.clock, self.work, self.stop.is_set, listening)

        self.thread = threading.Thread(target=run)
        self.thread.start()
        assert ready.wait(5.0)
        self.port = ports[0]

    def work(self, now):
        while self.time < now:
            self.body.advance(now)
            self.time += TICK

    def close(self):
        self.stop.set()
        self.thread.join(5.0)
        assert not self.thread.is_alive()

    def connected(self):
        return socket.create_connection(("127.0.0.1", self.port), timeout=5.0)


@pytest.fixture
def served():
    served = Served()
    yield served
    served.close()


def ask(client, data):
    client.sendall(data)
    return client.recv(1024)


def test_driver_runs_a_session_over_tcp(served, monkeypatch):
    monkeypatch.setattr("equipoise.robots.kst.robot.TIMEOUT", 1.0)
    robot = KstRobot(dial("127.0.0.1", served.port), served.clock)
    robot.connect()
    assert robot.measured() == pytest.approx(HOME)
    robot.start()
    replies, moment = [], served.clock.now()
    for i in range(60):
        robot.send((0.0005 * i, *HOME[1:]))
        moment += 0.005
        served.clock.wait_until(moment)
        replies += robot.replies()
    robot.stop()
    replies += robot.replies()
    assert len(replies) == 60
    assert robot.measured()[0] == pytest.approx(0.0295, abs=1e-4)
    robot.close()
    served.thread.join(5.0)
    assert not served.thread.is_alive(), "the server ends with its client's end"
    with pytest.raises(LinkError, match="check cable"):
        dial("127.0.0.1", served.port)()


def test_second_client_is_never_answered(served):
    with served.connected() as first, served.connected() as second:
        second.settimeout(0.3)
        second.sendall(b"getJointsPositions\n")
        assert ask(first, b"getJointsPositions\n").endswith(b"_\n")
        with pytest.raises(TimeoutError):
            second.recv(1024)


def test_servo_goes_on_when_the_client_vanishes(served):
    with served.connected() as client:
        assert ask(client, b"startDirectServoJoints\n") == b"done\n"
        time.sleep(0.3)
        assert ask(client, b"jp_0.1_\n\n") == b"done\n"
    with served.connected() as another:
        another.settimeout(0.3)
        another.sendall(b"getJointsPositions\n")
        with pytest.raises(TimeoutError):
            another.recv(1024)
    assert served.body.running
    assert served.body.measured()[0] == pytest.approx(0.1, abs=1e-3)


def test_servo_goes_on_when_the_connection_is_reset(served):
    client = served.connected()
    assert ask(client, b"startDirectServoJoints\n") == b"done\n"
    time.sleep(0.1)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
    time.sleep(0.1)
    assert served.thread.is_alive()
    assert served.body.running


def test_the_answers_of_a_motion_come_in_two_segments(served):
    with served.connected() as client:
        assert ask(client, b"jRelVel_0.5_\n") == b"done\n"
        time.sleep(0.05)
        assert ask(client, b"jp_0.05_\n\n") == b"done\n"
        assert ask(client, b"doPTPinJS\n") == b"done\n"
        assert client.recv(1024) == b"done\n"
        assert ask(client, b"getPin3\n") == b"1\n\n"


def test_port_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = KstServer(Follower(), SPEEDS)
        with pytest.raises(OutsideError, match=f"port {port}"):
            serve(server, ("127.0.0.1", port), SystemClock(), lambda _: None, lambda: True)


def test_a_host_that_has_no_address_is_not_waited_for():
    clock = VirtualClock()
    robot = KstRobot(dial("no.such.host.invalid", 30001), clock)
    with pytest.raises(OutsideError, match="there is no host no.such.host.invalid"):
        robot.connect()
    assert clock.now() < 1.0  # an address that does not answer is tried for a minute
