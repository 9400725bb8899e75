"""The emulated hardware, in virtual time but for its port."""

import select
import socket

import pytest

from equipoise.errors import OutsideError
from equipoise.rig.clocks import VirtualClock
from equipoise.robots.emulation import Emulation
from tests.rig.test_simulated_rig import ARM, NOMINAL, PENDULUM

ASK = b"getJointsPositions\n"


class Stage:
    """An emulation whose time passes while acts that were planned for it are done."""

    def __init__(self):
        self.clock, self.said, self.plan = VirtualClock(), [], []
        parts = ARM, PENDULUM, NOMINAL, self.clock
        self.emulation = Emulation("kst", *parts, port=0, say=self.said.append)
        self.port = int(self.emulation.hardware.address.rpartition(":")[2])

    def run(self, until):
        def stop():
            while self.plan and self.clock.now() >= self.plan[0][0]:
                self.plan.pop(0)[1]()
            return self.clock.now() >= until

        self.emulation.run(stop)

    def connect(self):
        self.client = socket.create_connection(("127.0.0.1", self.port), timeout=5.0)

    def send(self, data):
        return lambda: self.client.sendall(data)

    def came(self):
        return self.client.recv(4096) if select.select([self.client], [], [], 0.0)[0] else b""


def test_one_client_is_answered_and_the_server_started_again_after_its_end():
    stage, came, clients = Stage(), [], []

    def connect():
        stage.connect()
        clients.append(stage.client)

    stage.plan = [
        (0.10, connect),
        (0.15, stage.send(ASK)),
        (0.30, lambda: came.append(stage.came())),
        (0.32, connect),  # a second one
        (0.35, stage.send(ASK)),
        (0.40, lambda: came.append(stage.came())),
        (0.45, lambda: clients[0].sendall(b"end\n")),
        (0.60, connect),
        (0.70, stage.send(ASK)),
        (0.90, lambda: came.append(stage.came())),
    ]
    stage.run(1.5)
    for client in clients:
        client.close()
    assert [answer.count(b"_") for answer in came] == [7, 0, 7]


def test_a_client_that_vanishes_leaves_the_servo_on_until_the_word_start():
    stage, running = Stage(), []
    bench = stage.emulation.hardware.bench
    stage.plan = [
        (0.1, stage.connect),
        (0.2, stage.send(b"startDirectServoJoints\n")),
        (0.5, lambda: stage.client.close()),
        (2.0, lambda: running.append(bench.body.running)),
        (2.1, stage.emulation.acts["start"]),
        (2.5, lambda: running.append(bench.body.running)),
    ]
    stage.run(3.0)
    assert running == [True, False]
    assert "vanished" in stage.said[0]


def test_a_port_in_use_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        parts = ARM, PENDULUM, NOMINAL, VirtualClock()
        with pytest.raises(OutsideError):
            Emulation("kst", *parts, port=taken.getsockname()[1])
