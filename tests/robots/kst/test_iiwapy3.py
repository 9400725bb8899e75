"""A session of the independent client iiwaPy3 against the emulated server, byte for byte.

Written from the recorded bytes of its calls, with its line ends (two after a setpoint), its numbers
(rounded up to 1e-4) and its waits. It has no framing: whatever one `recv` brings is an answer.
"""

from math import ceil

import pytest

from equipoise.errors import LinkError
from tests.robots.kst.follower import HOME, Bench


class Client:
    """What iiwaPy3 does with a socket."""

    def __init__(self, bench):
        self.bench = bench
        bench.wait(1.0)

    def send(self, data):
        self.bench.client.write(data)

    def recv(self):
        for _ in range(30_000):
            if data := self.bench.client.read():
                return data
            self.bench.wait(0.001)
        pytest.fail("iiwaPy3 would wait for ever")

    def ask(self, data):
        self.send(data)
        return self.recv()


def numbers(q):
    return b"".join(f"{ceil(value * 10000) / 10000.0}_".encode() for value in q)


def floats(line, count):
    assert line.endswith(b"_\n")
    values = [float(field) for field in line.split(b"_")[:-1]]
    assert len(values) == count
    return values


def test_session():
    bench = Bench()
    client = Client(bench)

    # getJointsPos
    assert client.ask(b"getJointsPositions\n") == b"0.0_0.4364_0.0_-1.3962_0.0_1.309_0.0_\n"

    # realTime_startDirectServoJoints
    assert client.ask(b"startDirectServoJoints\n") == b"done\n"
    bench.wait(0.3)

    # Ten setpoints of each kind
    q = list(HOME)
    kinds = (
        (b"jp_", None),
        (b"jpJP_", 7),
        (b"jpExT_", 7),
    )
    for command, count in kinds:
        for _ in range(10):
            q[0] += 0.00037
            answer = client.ask(command + numbers(q) + b"\n\n")
            if count is None:
                assert answer == b"done\n"
            else:
                floats(answer, count)
            bench.wait(0.002)
    bench.wait(0.1)
    assert bench.body.measured()[0] == pytest.approx(ceil(q[0] * 1e4) / 1e4, abs=1e-6)

    # realTime_stopDirectServoJoints
    assert client.ask(b"stopDirectServoJoints\n") == b"done\n"
    bench.wait(0.3)
    assert not bench.body.running
    floats(client.ask(b"getJointsPositions\n"), 7)

    # close
    client.send(b"end\n")
    bench.wait(1.0)
    with pytest.raises(LinkError):
        bench.client.read()
