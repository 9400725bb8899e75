"""A session of the independent client iiwaPy3 against the emulated server, byte for byte.

Written from the recorded bytes of its calls, with its line ends (two after a setpoint), its numbers
(rounded up to 1e-4) and its waits. It has no framing: whatever one `recv` brings is an answer.
"""

from math import ceil

import pytest

from equipoise.errors import LinkError
from tests.robots.kst.follower import HOME, Bench


def ask(bench, data):
    """Return what one `recv` of the client brings after a command."""
    bench.client.write(data)
    for _ in range(1000):
        if answer := bench.client.read():
            return answer
        bench.wait(0.001)
    pytest.fail("iiwaPy3 would wait for ever")


def numbers(q):
    return b"".join(f"{ceil(value * 10000) / 10000.0}_".encode() for value in q)


def test_session():
    bench, q = Bench(), list(HOME)
    bench.wait(1.0)
    for lamp in (b"blueOn\n", b"blueOff\n"):
        assert ask(bench, lamp) == b"done\n"
    assert ask(bench, b"getJointsPositions\n") == b"0.0_0.4364_0.0_-1.3962_0.0_1.309_0.0_\n"
    assert ask(bench, b"startDirectServoJoints\n") == b"done\n"
    bench.wait(0.3)
    for command, fields in ((b"jp_", 0), (b"jpJP_", 7), (b"jpExT_", 7)):
        for _ in range(10):
            q[0] += 0.00037
            answer = ask(bench, command + numbers(q) + b"\n\n")
            assert answer == b"done\n" if fields == 0 else answer.count(b"_") == fields
            bench.wait(0.002)
    bench.wait(0.1)
    assert bench.body.measured()[0] == pytest.approx(ceil(q[0] * 1e4) / 1e4, abs=1e-6)
    assert ask(bench, b"stopDirectServoJoints\n") == b"done\n"
    bench.wait(0.3)
    assert not bench.body.running
    start = bench.body.measured()[0]
    for command in (b"jRelVel_0.1_\n", b"jp_" + numbers(HOME) + b"\n\n", b"doPTPinJS\n"):
        assert ask(bench, command) == b"done\n"
        bench.wait(0.05)
    assert bench.body.measured()[0] == pytest.approx(start), "the second receive is for the end"
    assert ask(bench, b"") == b"done\n"
    assert bench.body.measured() == pytest.approx(HOME, abs=1e-4)
    assert ask(bench, b"Torques_m_J\n").count(b"_") == 7
    bench.client.write(b"end\n")
    bench.wait(1.0)
    with pytest.raises(LinkError):
        bench.client.read()
